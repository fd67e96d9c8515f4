// The page of one run: its screen, and the plots below it.
"use strict";

(() => {
  const read = id => { const node = document.getElementById(id); return node && JSON.parse(node.textContent); };
  const part = read("part-data"), found = read("screen-data");
  showScreen(document.getElementById("screen"), part, found, found ? found.um : 1);
  document.querySelectorAll("[data-copy]").forEach(button => button.addEventListener("click", () => {
    navigator.clipboard?.writeText(button.parentElement.querySelector("code").textContent).then(() => { button.textContent = "Copied"; });
  }));
  drawPlots(part ? part.colours : found ? found.colours : {});
})();
