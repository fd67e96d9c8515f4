// The part in 3D with the field of disagreement: steps of the model, single views, candidate effects. No library, no network.
"use strict";

// Show a part in the elements of `root`; `more` are the fields of candidate effects, `eye` where it was looked at from.
function showPart(root, data, more, eye) {
  const numbers = partNumbers(data), { vertices, near, unpack, onVertices } = numbers;
  const canvas = root.querySelector("canvas"), drawing = partDrawing(canvas, numbers, data.colours);
  const slider = root.querySelector("input[type=range]"), choice = root.querySelector("select");
  const title = root.querySelector("[data-title]"), bar = root.querySelector("[data-bar]");
  const play = root.querySelector("button[data-play]");
  const look = partEye(canvas, data.box, eye, () => { draw(); root.dispatchEvent(new CustomEvent("eye")); }, pick);
  if (data.words) canvas.setAttribute("aria-label", `${data.words.picture} ${canvas.getAttribute("aria-label").split(". ").slice(1).join(". ")}`);
  let steps = [], shown = -1, wanted = false, selection = null;

  const candidates = [];
  function learn(more) {  // patches of a diagnosis lie elsewhere: each of ours takes the nearest
    const before = choice.value;
    candidates.length = 0;
    [...choice.options].filter(o => o.value.startsWith("c")).forEach(o => o.remove());
    const nearest = nearestPlaces(data, numbers, more.places), um = more.um;
    const of = field => Float32Array.from(nearest, j => field[j] === null ? NaN : field[j] * um);
    for (const c of more.candidates) candidates.push({ name: c.effect, steps: [
      { name: "as it is", mean: more.now.mean * um, values: of(more.now.field) },
      { name: `if ${c.effect} were added`, mean: c.mean * um, values: of(c.field) }] });
    candidates.forEach((c, i) => choice.add(new Option(`predicted: ${c.name}`, `c${i}`)));
    if (choice.value !== before) { choose(); names(); label(); }  // what was shown is not there any more
  }
  choice.length = 1;
  data.views.forEach((view, i) => choice.add(new Option(`view ${view.name} against the others`, `v${i}`)));
  if (more) learn(more);

  const isSigned = () => choice.value.startsWith("v");
  const full = () => isSigned() ? data.fullSigned : data.full;
  function choose() {
    const i = Number(choice.value.slice(1));
    if (choice.value === "s") steps = selection.map(s => ({ ...s, on: onVertices(unpack(s.values)) }));
    else if (choice.value.startsWith("c")) steps = candidates[i].steps.map(s => ({ ...s, on: onVertices(s.values) }));
    else steps = data.steps.map((s, k) => ({ name: s.name, noise: s.noise,
      mean: isSigned() ? data.views[i].means[k] : s.mean,
      on: onVertices(unpack(isSigned() ? data.views[i].steps[k] : s.values)) }));
    slider.max = steps.length - 1;
    slider.value = Math.min("cs".includes(choice.value[0]) ? 1 : data.end, steps.length - 1);
    shown = -1; label(); draw();
    const told = { kind: choice.value[0], text: choice.selectedOptions[0].text, means: steps.map(s => s.mean) };
    root.dispatchEvent(new CustomEvent("shown", { detail: told }));  // "a"ll, a "v"iew, a "c"andidate effect, what was "s"elected
  }
  function label() {
    const k = Math.round(Number(slider.value)), s = steps[k], signed = isSigned();
    const words = signed ? "this view lies off by {} on average" : data.words?.all ?? "the views disagree by {} on average";
    title.textContent = `${s.name}: ${words.replace("{}", length(s.mean))}`;
    slider.setAttribute("aria-valuetext", title.textContent);
    root.querySelectorAll("[data-steps] button").forEach((b, i) => b.setAttribute("aria-pressed", String(i === k)));
    const colours = data.colours[signed ? "signed" : "field"].map(c => `rgb(${c.join(",")})`).join(",");
    bar.querySelector("i").style.background = `linear-gradient(90deg, ${colours})`;
    const f = full(), large = f >= 999.5, shown = large ? f / 1e3 : f;
    bar.querySelectorAll("b").forEach((b, i) => {
      const x = signed ? -shown + i * shown : i * shown / 2;
      b.textContent = `${signed && i === 2 ? "+" : ""}${digits(x)}${i === 2 ? large ? " mm" : " µm" : ""}`.replace("-", "−");
    });
    const ends = signed ? ["inwards of the others", "outwards"] : data.words?.ends ?? ["views agree", "views disagree"];
    bar.querySelector("span").replaceChildren(...ends.map(end => {
      const text = document.createElement("span");
      text.textContent = end;
      return text;
    }));
    const grey = bar.querySelector("small");
    grey.hidden = !data.unseen;
    grey.textContent = signed ? "nothing to compare with" : "seen by one view only";
  }
  const digits = x => x === 0 ? "0" : Number(x.toPrecision(3)).toString();
  const length = um => um >= 999.5 ? `${digits(um / 1e3)}\u00a0mm` : `${digits(um)}\u00a0µm`;
  function names() {
    const list = root.querySelector("[data-steps]");
    choice.parentElement.hidden = choice.length < 2;
    list.replaceChildren(...steps.map((s, i) => {
      const b = document.createElement("button");
      b.type = "button"; b.textContent = s.name;
      b.onclick = () => glide(i);
      return b;
    }));
  }
  function draw() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => {
      wanted = false;
      const t = Number(slider.value), k = Math.min(Math.floor(t), steps.length - 2);
      if (k !== shown) {
        drawing.write(steps[k].on, steps[k + 1].on);
        shown = k;
      }
      drawing.paint({ turn: look.turn(), scale: look.scales(), shift: look.shift(), zoom: look.now().zoom, blend: t - k, full: full(), signed: isSigned() });
    });
  }
  let gliding = 0;
  function glide(to) {
    cancelAnimationFrame(gliding);
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches, from = Number(slider.value), begun = performance.now();
    const lasting = still ? 1 : 700 * Math.max(1, Math.abs(to - from));
    const move = now => {
      const share = Math.min(1, Math.max(0, (now - begun) / lasting));
      slider.value = from + (to - from) * share; label(); draw();
      if (share < 1) gliding = requestAnimationFrame(move);
    };
    gliding = requestAnimationFrame(move);
  }
  slider.oninput = () => { cancelAnimationFrame(gliding); label(); draw(); };
  choice.onchange = () => { choose(); names(); label(); };
  play.onclick = () => { const last = steps.length - 1; slider.value = Math.min(data.begin, last - 1); glide(last); };

  function pick(e) {
    const best = nearestVertex(numbers, canvas, look, e);
    if (best < 0) return;
    const flat = [0, 1, 2].map(k => vertices[3 * best + k] / 32767 * data.size + data.centre[k]);
    const place = [0, 1, 2].map(k => flat.reduce((sum, value, row) => sum + value * data.axes[row][k], 0));
    root.dispatchEvent(new CustomEvent("pick", { detail: { place, patch: near[3 * best] } }));  // reference frame, length_unit
  }
  new ResizeObserver(draw).observe(canvas);
  root.classList.add("live");
  choose(); names(); label();
  return {
    names: () => data.steps.map(s => s.name),
    at: () => Number(slider.value),
    glide,
    learn,
    eye: look.now,
    look(eye) { look.set(eye); draw(); },
    jump(to) { cancelAnimationFrame(gliding); slider.value = to; label(); draw(); },
    stop() { cancelAnimationFrame(gliding); },
    show(value) {  // "all", "v3", "c0", "s"
      choice.value = value; choose(); names(); label();
    },
    predict(name) {  // from the field as it is to that with a candidate effect
      const i = candidates.findIndex(c => c.name === name);
      if (i < 0) return false;
      this.show(`c${i}`); this.jump(0); glide(1);
      return true;
    },
    choose(name, states) {  // two states {name, mean, values}: of everything, and of what was chosen
      [...choice.options].filter(o => o.value === "s").forEach(o => o.remove());
      selection = states;
      if (states) choice.add(new Option(`chosen: ${name}`, "s"), 1);
      this.back();
    },
    back() { this.show(selection ? "s" : "all"); },  // from a view or a candidate effect to what was chosen
  };
}
