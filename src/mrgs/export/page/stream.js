// The parts of the model, as the browser reads them in the file.

// Calls take(text) with each part, in the order of the file, as soon as it is whole, and then end().
function readParts(take, end) {
  const takeWhole = () => {
    for (const part of document.querySelectorAll("script.part")) {
      if (document.readyState === "loading" && !part.nextSibling) return; // the browser still reads it
      take(part.textContent);
      part.remove();
    }
  };
  const observer = new MutationObserver(takeWhole);
  observer.observe(document.body, { childList: true });
  document.addEventListener("DOMContentLoaded", () => {
    takeWhole();
    observer.disconnect();
    end();
  });
}
