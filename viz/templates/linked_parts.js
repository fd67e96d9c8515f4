// Two runs side by side: what turns the one part turns the other, and both show the same view.
"use strict";

(() => {
  const roots = [...document.querySelectorAll(".pair .part")], parts = roots.map(root =>
    showPart(root, JSON.parse(document.getElementById(`${root.id}-data`).textContent)));
  if (parts.some(part => !part)) return;  // the still pictures stay
  roots.forEach((root, i) => {
    const own = root.querySelector("select");
    root.addEventListener("eye", () => parts.forEach((part, k) => k !== i && part.look(parts[i].eye())));
    own.addEventListener("change", () => roots.forEach((other, k) => {
      const same = [...other.querySelector("select").options].find(o => o.text === own.selectedOptions[0].text);
      if (k !== i) parts[k].show(same ? same.value : "all");
    }));
  });
})();
