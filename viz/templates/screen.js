// One screen: the part as it is and as it was or would be, the legend as a histogram, why, and candidates to compare.
"use strict";

// `part` is the data of the part, `found` the screen of diagnosis.json or null; `um` micrometres in one length_unit.
function showScreen(root, part, found, um) {
  const at = name => root.querySelector(`[data-${name}]`);
  // What is allowed is not red.
  const allowed = Number(at("legend")?.dataset.tolerance) || 0;
  if (part) part.full = Math.max(part.full, allowed);
  const sides = ["now", "then"].map(name => at(name)).filter(Boolean);
  const views = sides.length && part ? sides.map((side, i) => partStage(side, part, i)) : [];
  views.forEach((view, i) => view.moved = () => views.forEach((other, k) => k !== i && other.look(view.eye())));
  const numbers = part && partNumbers(part), own = part && part.steps.map(s => numbers.unpack(s.values));
  const nearest = found && found.places && part ? nearestPlaces(part, numbers, found.places) : null;
  const mapped = field => Float32Array.from(nearest, j => field[j] === null ? NaN : field[j] * um);
  // Without a name, and nothing added yet, the best candidate stands beside the model as it is.
  const first = found && nearest && (found.candidates.find(c => c.field && found.named.includes(c.effect))
    || found.verdict === "unknown_effect" && found.candidates.find(c => c.field)) || null;
  let shown = first, asked = null, view = -1;

  // What stands left and right: {title, values, mean}.
  function pair() {
    if (shown) return [
      { title: "Now", values: mapped(found.now.field), mean: found.now.mean * um },
      { title: `${found.verdict === "unknown_effect" ? "Nearest known effect" : "With"} ${shown.effect} (predicted)`, values: mapped(shown.field), mean: shown.mean * um }];
    const { begin, end } = part, step = (k, title) => ({ title, values: own[k], mean: part.steps[k].mean });
    return end > begin ? [step(end - 1, `Before: ${part.steps[end - 1].name}`), step(end, `Now, ${part.steps[end].name}`)] : [step(end, "Now"), step(end + 1, "Stitched cloud, each view moved")];
  }

  function draw() {
    if (!views.length) return;
    const both = pair(), one = part.views.find(v => v.index === view);
    both.forEach((state, i) => {
      const k = shown ? part.end : part.end - (part.end > part.begin) + i;
      const signed = one && (i === 0 || !shown);
      const values = signed ? numbers.unpack(one.steps[k]) : state.values;
      views[i].show(values, signed ? part.fullSigned : part.full, Boolean(signed));
      views[i].title.textContent = signed ? `${state.title}: view ${one.name} against the others, blue −${shortLength(part.fullSigned)} to red +${shortLength(part.fullSigned)}` : `${state.title}: ${roundLength(state.mean)} on average`;
    });
    views.forEach(v => v.tag(tags));
    legend(both);
  }

  // Places with their numbers on both parts: at first the worst, the best and one between that are in sight.
  let tags = [];
  function firstTags() {
    const values = present().values, all = views[0].front().filter(([k]) => Number.isFinite(values[k])), drawn = numbers.onVertices(values);
    // Where the colour, which is a mean of patches, is that of the number.
    const alike = all.filter(([k, , , i]) => Math.abs(drawn[i] - values[k]) < 0.15 * values[k]), front = (alike.length > 9 ? alike : all).sort((a, b) => values[a[0]] - values[b[0]]);
    const worst = worstPatch(values);
    if (worst >= 0 && isWorst(values[worst]) && front.some(([k]) => k === worst)) tags.push({ patch: worst, worst: true, x: 9, y: 9 });
    for (const wanted of tags.length ? [0, 0.5] : [1, 0, 0.5]) {
      const order = front.map((f, i) => [Math.abs(i / front.length - wanted), f]).sort((a, b) => a[0] - b[0]);
      const free = order.find(([, f]) => tags.every(t => Math.hypot(f[1] - t.x, f[2] - t.y) > 0.22));
      if (free) tags.push({ patch: free[1][0], x: free[1][1], y: free[1][2], vertex: free[1][3] });
    }
  }
  // What the tiles speak of: the first picture beside a candidate, else the last.
  const present = () => pair()[shown || part.end === part.begin ? 0 : 1];
  // Called the worst is what the tile says; the part's own patches may lie beside it.
  const isWorst = value => !shown || value > 0.95 * found.now.worst * um;
  const worstPatch = values => values.reduce((best, v, k) => Number.isFinite(v) && (best < 0 || v > values[best]) ? k : best, -1);
  // A click on the tile of the worst place turns the part there.
  const tile = root.ownerDocument.querySelector("[data-tile=worst]");
  if (tile && views.length) tile.parentElement.addEventListener("click", () => {
    const { values } = present(), patch = worstPatch(values);
    tags = [...tags.filter(t => !t.worst).slice(-2), { patch, worst: isWorst(values[patch]) }];
    views.forEach(v => v.face(patch)); draw();
  });
  views.forEach(v => v.picked = patch => {
    tags = tags.some(t => t.patch === patch) ? tags.filter(t => t.patch !== patch) : [...tags.slice(-3), { patch, picked: true }];
    draw();
    const [a, b] = pair(), sigma = part.sigma ? part.sigma[patch] : null, seen = part.seen ? part.seen[patch] : null;
    const words = [`${shortLength(a.values[patch])} → ${shortLength(b.values[patch])}`, sigma && `± ${shortLength(sigma)}`, seen && `${seen} views see it`];
    say(`This place: ${words.filter(Boolean).join(", ")}.`);
  });
  const say = text => { const told = at("told"); if (told) told.textContent = text; };

  // The colours as a histogram of the surface, left grey and right blue, with what is allowed.
  function legend(both) {
    const place = at("legend");
    if (!place) return;
    const bins = 24, full = part.full, high = 330, wide = Math.max(place.clientWidth, 120);
    const counts = both.map(state => {
      const out = new Array(bins).fill(0), seen = state.values.filter(Number.isFinite);
      seen.forEach(v => out[Math.min(bins - 1, Math.max(0, Math.floor(v / full * bins)))]++);
      return out.map(n => n / Math.max(seen.length, 1));
    });
    // What lies beyond the scale may be nearly all: it does not press the others together.
    const most = Math.max(...counts.flatMap(own => own.slice(0, -1)), 0.02), left = 50, room = wide - left - 22, Y = um => 12 + (1 - um / full) * (high - 34), step = (high - 34) / bins;
    const svg = svgNode("svg", { class: "plot-svg", viewBox: `0 0 ${wide} ${high}`, width: wide, height: high, role: "img", "aria-label": "Share of the surface by how far the views disagree there" });
    for (let i = 0; i < bins; i++) {
      svg.append(svgNode("rect", { x: left, y: Y((i + 1) / bins * full), width: 14, height: step + 0.5, fill: colourAt(part.colours.field, (i + 0.5) / bins) }));
      counts.forEach((own, k) => svg.append(svgNode("rect", { class: k ? "then" : "now", x: left + 18, y: Y((i + 1) / bins * full) + (k ? step * 0.3 : 0.5), width: room * Math.min(1, own[i] / most), height: k ? step * 0.5 : step - 1 },
        svgNode("title", {}, `${shortNumber(i / bins * full)} to ${shortNumber((i + 1) / bins * full)} µm: ${Math.round(100 * own[i])} % of the surface`))));
    }
    for (const y of roundMarks(0, full, 6)) svg.append(svgNode("text", { x: left - 5, y: Y(y) + 4, "text-anchor": "end" }, shortNumber(y)));
    if (allowed && allowed <= full) svg.append(svgNode("line", { class: "allowed", x1: left - 4, x2: wide, y1: Y(allowed), y2: Y(allowed) }), svgNode("text", { class: "axis", x: wide, y: Y(allowed) - 4, "text-anchor": "end" }, `${shortNumber(allowed)} µm`));
    svg.append(svgNode("text", { x: left, y: high - 4 }, "grey: left · blue: right"));
    place.replaceChildren(svg);
    // As the light judges: with two standard errors, and no more of it than there is.
    const errors = part.sigma ? Float32Array.from(part.sigma).filter(Number.isFinite).sort() : [], least = allowed - 2 * (errors[errors.length >> 1] || 0);
    const within = both.map(({ values }) => { const seen = values.filter(Number.isFinite); return Math.floor(100 * seen.filter(v => v <= least).length / Math.max(seen.length, 1)); });
    const worst = Math.max(0, ...both.flatMap(s => Array.from(s.values).filter(Number.isFinite))), beyond = at("beyond"), hatched = at("hatched");
    const said = [worst > full && `The darkest colour begins at ${roundLength(full)}; the worst place has ${roundLength(worst)}.`, !tags.some(t => t.patch === worstPatch(present().values)) && "The worst place now is out of sight; a click on its number turns the part there."];
    if (beyond) beyond.textContent = said.filter(Boolean).join(" ");
    if (hatched) hatched.hidden = !views.some(v => v.hatched());
    const told = at("within");
    if (told) told.textContent = allowed ? `Within ${shortLength(allowed)}: ${within[0]} % → ${within[1]} %` : "";
  }

  // Why: measured dots and the predicted line over what the effect lives on.
  function why() {
    const place = at("why"), course = asked && asked.why || found && found.why, title = at("why-title");
    if (!place) return;
    if (!course) {
      if (!part || !part.byView) return;
      title.textContent = "How far each view lies off the others (µm)";
      const said = part.names.map((name, i) => `${name}: ${part.byView[i] === null ? "nothing to compare" : shortLength(part.byView[i])}`), seen = part.byView.map((v, i) => [i, v]).filter(([, v]) => v !== null);
      xyPlot(place, { x: { label: "views in their order", names: part.names }, y: { label: "µm" }, series: [{ kind: "dots", x: seen.map(s => s[0]), y: seen.map(s => s[1]), names: true, said: seen.map(s => said[s[0]]), tint: "dot" }] }, 230, i => chooseView(i < 0 ? -1 : seen[i][0]));
      return;
    }
    const deciding = !asked && found.deciding_view, rivals = deciding && deciding.expected.map(e => found.candidates.find(c => c.effect === e.effect));
    const plot = rivals ? duelPlot(rivals, deciding, part && part.names, um) : coursePlot(course, part && part.names, um, asked !== null || found.verdict !== "unknown_effect");
    title.textContent = plot.title;
    if (!asked && found.formula) say(found.formula);
    xyPlot(place, { ...plot.spec, pressed: course.views.indexOf(view) }, 230, i => chooseView(i < 0 ? -1 : course.views[i] ?? -1));
  }
  function chooseView(index) {
    view = index;
    const name = part && index >= 0 ? part.names[index] : "";
    say(index < 0 ? "" : part.views.some(v => v.index === index) ? `Shown: view ${name} against the others; its dot again shows all.` : `View ${name} has no field of its own on this page.`);
    draw();
  }

  root.querySelectorAll("[data-show]").forEach(button => button.addEventListener("click", () => {
    shown = asked = found.candidates.find(c => c.effect === button.dataset.show) || null; choose();
  }));
  function choose() {
    root.querySelectorAll("[data-show]").forEach(b => b.setAttribute("aria-pressed", String(shown !== null && b.dataset.show === shown.effect)));
    if (asked) for (const [key, value] of [["heldout", shown.heldout], ["mean", shown.mean], ["worst", shown.worst]]) {
      const tile = root.ownerDocument.querySelector(`[data-tile=${key}]`);
      if (tile) tile.textContent = found.now[key] === null || value === null ? "–" : fromTo(found.now[key] * um, value * um);
    }
    draw(); why();
  }
  if (views.length) firstTags();
  choose();
  let wide = root.clientWidth;
  new ResizeObserver(() => { if (root.clientWidth !== wide) { wide = root.clientWidth; why(); if (views.length) legend(pair()); } }).observe(root);
}

// Two lengths, as the tiles have them.
function fromTo(a, b) {
  const [[x, unit], [y, last]] = [a, b].map(um => roundLength(um).split("\u00a0"));
  return unit === last ? `${x} → ${y}\u00a0${last}` : `${x}\u00a0${unit} → ${y}\u00a0${last}`;
}

// The plot of one course of diagnosis.json; `known`: of an effect, and not of what has no name.
function coursePlot(course, names, um, known = true) {
  const mrad = course.value_unit === "rad", factor = mrad ? 1e3 : um, unit = mrad ? "mrad" : "µm";
  const inOrder = course.follows === "view order", seconds = course.unit === "s";
  const span = seconds ? Math.max(...course.at) : 0, [per, named] = span > 7200 ? [3600, "h"] : span > 120 ? [60, "min"] : [1, "s"];
  const x = course.at.map(a => seconds ? a / per : a), scaled = values => values.map(v => v * factor);
  const [measured, sigma, predicted, about] = [course.measured, course.sigma, course.predicted, course.predicted_sigma].map(scaled);
  const label = inOrder ? "views in their order" : course.follows.replace(/^j(\d+)(_deg| \(°\))$/, "angle of joint $1 (°)").replace(/_c$/, " (°C)").replaceAll("_", " ") + (seconds ? ` (${named})` : course.unit ? ` (${course.unit})` : "");
  const named_ = course.views.map(v => names ? names[v] : String(v)), middle = (Math.max(...predicted) + Math.min(...predicted)) / 2;
  const side = predicted.map(p => p > middle), first = inOrder ? side.findIndex(s => s !== side[0]) : -1;
  const jumps = first > 0 && side.slice(first).every(s => s !== side[0]);
  const said = measured.map((m, i) => `${course.views.length ? `${named_[i]}, ` : ""}${shortNumber(x[i])}: measured ${shortNumber(m)} ± ${shortNumber(2 * sigma[i])} ${unit}, predicted ${shortNumber(predicted[i])} ± ${shortNumber(2 * about[i])} ${unit}`);
  return {
    title: `Why: how far ${course.of} ${course.of.endsWith("views") ? "are off" : known ? "is off without it in the model" : "is off"} (${unit}), ± 2σ. Dots: measured${course.after ? ", open: with it in the model" : ""}. Line: ${course.of.endsWith("views") ? "their mean, bin by bin" : known ? "what the effect predicts" : "their trend"}`,
    perUnit: seconds ? 1 / per : 1,
    spec: {
      x: { label, names: inOrder && course.views.length === (names || []).length ? named_ : undefined }, y: { label: unit },
      shaded: jumps ? { from: (x[first - 1] + x[first]) / 2, said: `from ${named_[first]} on` } : undefined,
      series: [{ kind: "band", x, y: predicted, sigma: about, tint: "predicted" }, { kind: "line", x, y: predicted, step: jumps, tint: "predicted" }, { kind: "dots", x, y: measured, sigma, names: course.views.length > 0, said, tint: "dot" }, ...(course.after ? [{ kind: "dots", x, y: scaled(course.after), open: true, said: course.after.map((a, i) => `${named_[i]}, ${shortNumber(x[i])}: ${shortNumber(a * factor)} ${unit} with it in the model`), tint: "0" }] : [])],
    },
  };
}

// Rivals over the same dots, and in a stripe what each expects in the view that decides.
function duelPlot(rivals, view, names, um) {
  const plots = rivals.map(c => coursePlot(c.why, names, um)), [first] = plots, factor = rivals[0].why.value_unit === "rad" ? 1e3 : um, unit = first.spec.y.label;
  const x = view.at * first.perUnit, tints = ["predicted", "0", "2"], dashes = [null, "6 4", "2 3"], drawn = ["solid", "dashed", "dotted"], [, , dots] = first.spec.series;
  const lines = plots.flatMap((plot, k) => plot.spec.series.slice(0, 2).map(s => ({ ...s, tint: tints[k], dashed: dashes[k] })));
  const told = (value, sigma) => [value, 2 * sigma].map(v => shortNumber(Number((v * factor).toPrecision(2)))).join(" ± ");
  const highest = view.expected.map((_, k) => k).sort((a, b) => view.expected[b].value - view.expected[a].value);
  const expected = view.expected.map((e, k) => ({ kind: "dots", x: [x], y: [e.value * factor], sigma: [e.sigma * factor], tint: tints[k], open: true,
    said: [`${e.effect} expects ${told(e.value, e.sigma)} ${unit} there; one view scatters by ± ${shortNumber(2 * view.sigma * factor)}`], label: `${e.effect}: ${told(e.value, e.sigma)}`, lower: highest.indexOf(k) }));
  const parted = expected.some((_, k) => expected.slice(k + 1).some((_, m) => { const a = view.expected[k], b = view.expected[k + 1 + m]; return Math.abs(a.value - b.value) > 2 * Math.hypot(a.sigma, b.sigma); }));
  return {
    title: `${["", "", "Two", "Three"][rivals.length]} suspects, the same dots: how far ${rivals[0].why.of} is off with none of them in the model (${unit}), ± 2σ. ${rivals.map((c, k) => `${c.effect} ${drawn[k]}`).join(", ")}. Stripe: what each expects in the view that decides${parted ? "" : "; they part in other directions than this one"}`,
    spec: { ...first.spec, shaded: undefined, stripe: { at: x, said: `measure here: ${shortNumber(x)}${rivals[0].why.unit === "°" ? "°" : `\u00a0${rivals[0].why.unit}`}` }, series: [...lines, ...expected, dots] },
  };
}

// One part on its stage: a canvas, and above it places with their numbers.
function partStage(card, data, index) {
  const canvas = card.querySelector("canvas"), above = card.querySelector("svg"), numbers = partNumbers(data);
  const { vertices, normals, near, weight, count } = numbers, drawing = partDrawing(canvas, numbers, data.colours);
  const stage = { title: card.querySelector("h2"), moved: null, picked: null };
  const look = partEye(canvas, data.box, null, () => { draw(); if (stage.moved) stage.moved(); }, e => {
    const best = nearestVertex(numbers, canvas, look, e);
    if (best >= 0 && stage.picked) stage.picked(near[3 * best]);
  });
  let state = { values: null, full: 1, signed: false }, tags = [], wanted = false;
  const project = i => {
    const m = look.turn(), [sx, sy] = look.scales(), [panX, panY] = look.shift(), [p, q, r] = [0, 1, 2].map(k => vertices[3 * i + k] / 32767);
    return [(m[0] * p + m[3] * q + m[6] * r) * sx + panX, (m[1] * p + m[4] * q + m[7] * r) * sy + panY, m[2] * p + m[5] * q + m[8] * r];
  };
  const depthOf = i => { const m = look.turn(); return (m[2] * normals[3 * i] + m[5] * normals[3 * i + 1] + m[8] * normals[3 * i + 2]) / 127; };
  const vertexOf = patch => {
    let best = -1, most = -1;
    for (let i = 0; i < count; i++) if (near[3 * i] === patch && weight[3 * i] > most) { best = i; most = weight[3 * i]; }
    return best;
  };
  function draw() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => { wanted = false; paint(); });
  }
  function paint() {
    drawing.paint({ turn: look.turn(), scale: look.scales(), shift: look.shift(), zoom: look.now().zoom, blend: 0, full: state.full, signed: state.signed });
    const w = canvas.clientWidth, h = canvas.clientHeight;
    above.setAttribute("viewBox", `0 0 ${w} ${h}`);
    const nodes = [], taken = { left: [], right: [] }, largest = state.values ? Math.max(...state.values.filter(Number.isFinite)) : NaN;
    for (const tag of tags) {
      const i = tag.vertex ?? (tag.vertex = vertexOf(tag.patch));
      if (i < 0 || depthOf(i) < 0.05 || !state.values) continue;
      const [x, y] = project(i), px = (x + 1) / 2 * w, py = (1 - y) / 2 * h, side = px > w / 2 ? "right" : "left", value = state.values[tag.patch];
      if (px < 0 || px > w || py < 0 || py > h) continue;
      let ty = Math.min(h - 16, Math.max(16, py + 14));
      const away = ty > h / 2 ? -26 : 26;
      while (taken[side].some(t => Math.abs(t - ty) < 26)) ty += away;
      taken[side].push(ty);
      const tx = side === "right" ? w - (tag.worst ? 54 : 40) : tag.worst ? 54 : 40, text = Number.isFinite(value) ? `${tag.worst && value === largest ? "worst " : ""}${roundLength(value)}` : "no value", half = tag.worst ? 52 : 36;
      nodes.push(svgNode("line", { class: "lead", x1: px, y1: py, x2: tx, y2: ty }), svgNode("circle", { class: "spot", cx: px, cy: py, r: 4 }),
        svgNode("rect", { class: "tag", x: tx - half, y: ty - 12, width: 2 * half, height: 23, rx: 5 }), svgNode("text", { class: "tag-text", x: tx, y: ty + 4, "text-anchor": "middle" }, text));
    }
    above.replaceChildren(...nodes);
  }
  new ResizeObserver(draw).observe(canvas);
  // Paper shows what the screen shows.
  const print = card.querySelector("img");
  if (index >= 0) window.addEventListener("beforeprint", () => { paint(); print.src = canvas.toDataURL(); });
  return Object.assign(stage, {
    eye: look.now,
    look(eye) { look.set(eye); draw(); },
    face(patch) {
      const i = vertexOf(patch);
      if (i < 0) return;
      const [x, y, z] = [0, 1, 2].map(k => normals[3 * i + k]);
      look.set({ ...look.now(), yaw: -Math.atan2(x, z), pitch: Math.atan2(y, Math.hypot(x, z)), panX: 0, panY: 0 });
      // Turned, the part may be higher than the picture.
      const [panX, panY] = project(i).slice(0, 2).map(v => Math.max(-0.85, Math.min(0.85, v)) - v);
      look.set({ ...look.now(), panX, panY }); draw();
    },
    hatched: () => state.hatched,
    show(values, full, signed) {
      const on = numbers.onVertices(values);
      state = { values, full, signed, hatched: on.includes(UNKNOWN) };
      drawing.write(on, on); draw();
    },
    tag(next) { tags = next.map(t => ({ ...t })); draw(); },
    // Patches in sight with where they stand in the picture.
    front: () => {
      const out = new Map();
      for (let i = 0; i < count; i += 3) if (depthOf(i) > 0.4 && !out.has(near[3 * i])) out.set(near[3 * i], [...project(i).slice(0, 2), i]);
      return [...out].map(([k, [x, y, i]]) => [k, x, y, i]);
    },
  });
}
