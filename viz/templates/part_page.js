// The part on the page of one run.
"use strict";

(() => {
  const root = document.getElementById("part"), source = document.getElementById("part-data");
  if (!root || !source) return;
  const data = JSON.parse(source.textContent), part = showPart(root, data);
  if (!part || data.end <= data.begin || matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  // What was added is seen at work once: from the first model to the present one, as soon as the part is in sight.
  part.jump(data.begin);
  const seen = new IntersectionObserver(entries => {
    if (!entries.some(e => e.isIntersecting)) return;
    seen.disconnect();
    setTimeout(() => { if (part.at() === data.begin) part.glide(data.end); }, 900);
  }, { threshold: 0.6 });
  seen.observe(root.querySelector("canvas"));
})();
