// Two clicks on a photo and a length become an option of the command line; pixels are those of the scene's image.

function setUpMeasure() {
  const select = document.getElementById("measure-view");
  if (!select) return;
  const photos = [...document.querySelectorAll(".clickable")];
  const length = document.getElementById("measure-length");
  const option = document.getElementById("measure-option");
  let marks = [];

  const quoted = (text) => (/^[\w.,:+-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
  const place = ([x, y]) => quoted(`${select.value}:${x.toFixed(1)},${y.toFixed(1)}`);

  const tell = () => {
    const metres = numberOf(length.value);
    if (marks.length < 2) {
      option.textContent = marks.length ? "Click the second point." : "Click the two points in the photo.";
    } else if (!(metres > 0)) {
      option.textContent = "Type the distance in metres.";
    } else {
      const code = document.createElement("code");
      code.textContent = `--known-distance ${place(marks[0])} ${place(marks[1])} ${metres}`;
      option.replaceChildren(code);
    }
  };

  const clear = () => {
    marks = [];
    for (const mark of document.querySelectorAll(".mark")) mark.remove();
    tell();
  };

  const show = () => {
    clear();
    photos.forEach((photo, index) => { photo.hidden = index !== select.selectedIndex; });
  };

  const click = (photo, event) => {
    if (marks.length === 2) clear();
    const box = photo.getBoundingClientRect();
    const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    marks.push([x * photo.dataset.width, y * photo.dataset.height]);
    const mark = document.createElement("div");
    mark.className = "mark";
    mark.style.left = `${100 * x}%`;
    mark.style.top = `${100 * y}%`;
    photo.append(mark);
    tell();
  };

  for (const photo of photos) photo.addEventListener("click", (event) => click(photo, event));
  select.addEventListener("change", show);
  length.addEventListener("input", tell);
  document.getElementById("measure-clear").addEventListener("click", clear);
  show();
}
