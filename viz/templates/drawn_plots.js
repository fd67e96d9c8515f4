// Plots in the page's own colours, drawn from numbers alone: dots with whiskers, lines, bands, maps.
"use strict";

const svgSpace = (() => { const sheet = document.createElement("template"); sheet.innerHTML = "<svg></svg>"; return sheet.content.firstChild.namespaceURI; })();

function svgNode(tag, attributes = {}, ...children) {
  const node = document.createElementNS(svgSpace, tag);
  for (const [key, value] of Object.entries(attributes)) if (value !== undefined && value !== null) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

const shortNumber = x => x === 0 ? "0" : Number(x.toPrecision(3)).toString().replace("-", "−");
const shortLength = um => Math.abs(um) >= 999.5 ? `${shortNumber(um / 1e3)}\u00a0mm` : `${shortNumber(um)}\u00a0µm`;

// A length as one remembers it: two digits, whole micrometres from a hundred on.
const roundLength = um => shortLength(Number(um.toPrecision(Math.abs(um) >= 100 && Math.abs(um) < 1e3 ? 3 : 2)));

// Round values between two, about as many as asked for.
function roundMarks(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  if (!(rough > 0)) return [low];
  const step = power * [1, 2, 2.5, 5, 10].find(r => power * r >= rough * (1 - 1e-9)), marks = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) marks.push(Number((i * step).toPrecision(12)));
  return marks;
}

// One plot in `root`: {x: {label, names}, y: {label}, series: [{kind, x, y, sigma, names, said}]}; kinds are dots, line, band and ticks.
// `chosen(i)` is called with the number of a dot that is clicked.
function xyPlot(root, spec, height = 220, chosen = null) {
  const width = Math.max(root.clientWidth || 640, 240), [left, right, top, bottom] = [54, 10, 8, 36];
  const known = spec.series.filter(s => s.x.length);
  if (!known.length) return;
  const xs = known.flatMap(s => s.x), spread = s => (i, sign) => s.y ? s.y[i] + sign * 2 * (s.sigma ? s.sigma[i] : 0) : 0;
  const ys = known.flatMap(s => s.x.flatMap((_, i) => [spread(s)(i, -1), spread(s)(i, 1)])).concat(0);
  let [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const padX = (x1 - x0 || 1) * 0.04, padY = (y1 - y0 || 1) * 0.06;
  [x0, x1, y0, y1] = [x0 - padX, x1 + padX, y0 - padY, y1 + padY];
  const X = x => left + (x - x0) / (x1 - x0) * (width - left - right), Y = y => height - bottom - (y - y0) / (y1 - y0) * (height - top - bottom);
  const svg = svgNode("svg", { class: "plot-svg", viewBox: `0 0 ${width} ${height}`, width, height, role: chosen ? "group" : "img", "aria-label": spec.label || `${spec.y.label} over ${spec.x.label}` });
  for (const y of roundMarks(y0, y1, height > 150 ? 5 : 3)) svg.append(svgNode("line", { class: y === 0 ? "zero" : "grid", x1: left, x2: width - right, y1: Y(y), y2: Y(y) }),
    svgNode("text", { x: left - 6, y: Y(y) + 4, "text-anchor": "end" }, shortNumber(y)));
  const names = spec.x.names, wide = Math.max(52, 12 + 6.5 * Math.max(0, ...(names || []).map(n => n.length))), room = Math.max(1, Math.ceil((names ? names.length : 0) * wide / (width - left - right)));
  const marks = names ? names.map((_, i) => i).filter(i => i % room === 0) : roundMarks(x0, x1, width > 500 ? 8 : 4);
  for (const x of marks) svg.append(svgNode("text", { x: X(x), y: height - bottom + 16, "text-anchor": "middle" }, names ? names[x] : shortNumber(x)));
  svg.append(svgNode("text", { class: "axis", x: (left + width - right) / 2, y: height - 4, "text-anchor": "middle" }, spec.x.label));
  if (spec.shaded) svg.append(svgNode("rect", { class: "shaded", x: X(spec.shaded.from), y: top, width: Math.max(0, X(x1) - X(spec.shaded.from)), height: height - top - bottom }),
    svgNode("text", { class: "axis", x: X(spec.shaded.from) + 8, y: top + 13 }, spec.shaded.said));
  if (spec.stripe) svg.append(svgNode("rect", { class: "shaded", x: X(spec.stripe.at) - 12, y: top, width: 24, height: height - top - bottom }), svgNode("text", { class: "axis", x: X(spec.stripe.at), y: top + 10, "text-anchor": X(spec.stripe.at) > width - 80 ? "end" : "middle" }, spec.stripe.said));
  known.forEach((s, k) => {
    const order = s.x.map((_, i) => i).sort((a, b) => s.x[a] - s.x[b]), tint = `tint-${s.tint ?? k}`;
    const path = (points, end = "") => `M${points.map(([x, y]) => `${X(x).toFixed(1)} ${Y(y).toFixed(1)}`).join("L")}${end}`;
    if (s.kind === "band") svg.append(svgNode("path", { class: `band ${tint}`, d: path([...order.map(i => [s.x[i], spread(s)(i, 1)]), ...order.reverse().map(i => [s.x[i], spread(s)(i, -1)])], "Z") }));
    if (s.kind === "line") svg.append(svgNode("path", { class: `line ${tint}`, "stroke-dasharray": s.dashed, d: s.step ? stepped(s, order, X, Y) : path(order.map(i => [s.x[i], s.y[i]])) }));
    if (s.kind === "ticks") for (const x of s.x) svg.append(svgNode("line", { class: "tick", x1: X(x), x2: X(x), y1: Y(0) - 4, y2: Y(0) + 4 }));
    if (s.kind === "dots") s.x.forEach((x, i) => {
      const dot = svgNode("g", { class: `dot ${tint}` }, svgNode("line", { x1: X(x), x2: X(x), y1: Y(spread(s)(i, -1)), y2: Y(spread(s)(i, 1)) }),
        svgNode("circle", { class: s.open ? "open" : null, cx: X(x), cy: Y(s.y[i]), r: s.x.length > 60 ? 2.5 : 5 }));
      const said = s.said ? s.said[i] : `${shortNumber(x)}: ${shortNumber(s.y[i])}`;
      dot.append(svgNode("title", {}, said));
      if (chosen && s.names) {
        for (const [key, value] of [["tabindex", 0], ["role", "button"], ["aria-label", said], ["aria-pressed", String(i === spec.pressed)]]) dot.setAttribute(key, value);
        const press = () => {
          const on = dot.getAttribute("aria-pressed") !== "true";
          svg.querySelectorAll("[aria-pressed=true]").forEach(d => d.setAttribute("aria-pressed", "false"));
          dot.setAttribute("aria-pressed", String(on)); chosen(on ? i : -1);
        };
        dot.addEventListener("click", press);
        dot.addEventListener("keydown", e => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); press(); } });
      }
      svg.append(dot);
      if (s.label) svg.append(svgNode("text", { class: tint, x: X(x) + (X(x) > width / 2 ? -14 : 14), y: Y(s.y[i]) - 8 + 14 * (s.lower || 0), "text-anchor": X(x) > width / 2 ? "end" : "start" }, s.label));
    });
  });
  root.replaceChildren(svg);
}

// A course that jumps between two dots does so half-way between them.
function stepped(s, order, X, Y) {
  const half = order.map((i, k) => k + 1 < order.length ? (s.x[i] + s.x[order[k + 1]]) / 2 : s.x[i]);
  return order.map((i, k) => `${k ? "L" : "M"}${X(k ? half[k - 1] : s.x[i]).toFixed(1)} ${Y(s.y[i]).toFixed(1)}L${X(half[k]).toFixed(1)} ${Y(s.y[i]).toFixed(1)}`).join("");
}

// A map of values (rows of y) over x and y, coloured by stops; what nobody knows stays empty.
function mapPlot(root, spec, stops) {
  const [nx, ny] = [spec.x.length, spec.y.length], cell = Math.max(2, Math.min(26, (Math.min(root.clientWidth || 400, 420) - 40) / nx));
  const svg = svgNode("svg", { class: "plot-svg", viewBox: `0 0 ${nx * cell + 40} ${ny * cell + 40}`, width: nx * cell + 40, role: "img", "aria-label": spec.label });
  spec.values.forEach((row, j) => row.forEach((value, i) => value !== null && svg.append(svgNode("rect", { x: 36 + i * cell, y: 6 + (ny - 1 - j) * cell, width: cell + 0.5, height: cell + 0.5,
    fill: colourAt(stops, (value - spec.low) / (spec.high - spec.low)) }, svgNode("title", {}, `${shortNumber(spec.x[i])}°, ${shortNumber(spec.y[j])}°: ${shortLength(value)}`)))));
  for (const [i, anchor] of [[0, "start"], [nx - 1, "end"]]) svg.append(svgNode("text", { x: 36 + (i + (i > 0)) * cell, y: ny * cell + 20, "text-anchor": anchor }, `${shortNumber(spec.x[i])}°`));
  for (const j of [0, ny - 1]) svg.append(svgNode("text", { x: 32, y: 12 + (ny - 1 - j) * cell, "text-anchor": "end" }, `${shortNumber(spec.y[j])}°`));
  svg.append(svgNode("text", { class: "axis", x: 36, y: ny * cell + 36 }, `${shortLength(spec.low)} … ${shortLength(spec.high)}`));
  root.replaceChildren(svg);
}

function colourAt(stops, share) {
  const place = Math.min(1, Math.max(0, share)) * (stops.length - 1), k = Math.min(Math.floor(place), stops.length - 2);
  return `rgb(${stops[k].map((c, i) => Math.round(c + (place - k) * (stops[k + 1][i] - c))).join(",")})`;
}

// All plots of a page whose numbers stand beside them; drawn when they come into sight or are unfolded, and anew at another width.
function drawPlots(stops) {
  for (const root of document.querySelectorAll("[data-plot]")) {
    const spec = JSON.parse(document.getElementById(root.dataset.plot).textContent);
    const draw = () => root.clientWidth && (spec.values ? mapPlot(root, spec, stops[spec.colours]) : xyPlot(root, spec, spec.height));
    new ResizeObserver(draw).observe(root);
  }
}
