// How the thermal image is laid over the photo, for all views at once.

function setUpPairs() {
  for (const card of document.querySelectorAll(".card")) {
    const base = card.querySelector(".base");
    if (base) base.src = card.querySelector(".rgb").src;
  }
  const cards = document.querySelector(".cards");
  const buttons = [...document.querySelectorAll("button[data-mode]")];
  const slider = document.getElementById("blend");
  if (!cards || !slider) return;
  const show = (mode) => {
    cards.dataset.mode = mode;
    slider.parentElement.hidden = mode !== "blend";
    for (const button of buttons) button.setAttribute("aria-pressed", button.dataset.mode === mode);
    for (const image of cards.querySelectorAll(".warped")) {
      image.style.opacity = mode === "blend" ? slider.value / 100 : 1;
    }
  };
  for (const button of buttons) button.addEventListener("click", () => show(button.dataset.mode));
  slider.addEventListener("input", () => show("blend"));
  show("edges");
}

function showView(name) {
  const card = [...document.querySelectorAll(".card")].find((element) => element.dataset.view === name);
  if (!card) return;
  for (const marked of document.querySelectorAll(".card.marked")) marked.classList.remove("marked");
  card.classList.add("marked");
  card.scrollIntoView({ behavior: "smooth", block: "center" });
}
