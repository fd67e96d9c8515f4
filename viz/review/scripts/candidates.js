// What is missing: candidate effects with what they should leave, and the button that adds one.
import { at, element, signed, um } from "./elements.js";
import { chooseView } from "./plots.js";
import { foresee, predict } from "./scene.js";

const FIRST = 4;
let all = false;

// `ask` sends a command; `busy` while one that changes the run is under way.
export function showCandidates(state, ask, busy) {
  const root = at("missing"), found = state.diagnosis;
  why(found && found.why, state, found && found.verdict !== "unknown_effect");
  if (!found) {
    root.replaceChildren(element("p", { class: "soft" }, "Every effect of the library is tried on what the poses leave, and validated on views left out."),
      element("code", { class: "command" }, `stitch diagnose ${state.run}`));
    return;
  }
  const rows = all ? found.candidates : found.candidates.slice(0, FIRST);
  const most = Math.max(state.residual, state.heldout ?? 0, ...rows.map(c => c.heldout_if_added ?? 0));
  const table = [legend(), element("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Candidate effects" }, element("table", { class: "candidate" },
      element("thead", {}, element("tr", {}, ...["candidate effect", "rms if added (µm)", "posterior", ""].map(h => element("th", { scope: "col" }, h || element("span", { "aria-label": "add" }))))),
      element("tbody", {}, row("as it is", state.residual, state.heldout, most, state.floor), ...rows.flatMap(c => candidate(c, found, state, most, ask, busy))))),
  found.candidates.length > FIRST && element("button", { type: "button", "aria-expanded": String(all), onclick: () => { all = !all; showCandidates(state, ask, busy); } },
      all ? "Fewer candidate effects" : `${found.candidates.length - FIRST} further candidate effects`)].filter(Boolean);
  const open = all || root.querySelector("#tried[open]") !== null;
  root.replaceChildren(element("h3", {}, found.plain),
    ...(found.sentence ? [element("p", { class: "soft" }, signed(found.sentence))] : []),
    ...(found.verdict === "adequate" ? [element("details", { id: "tried", open }, element("summary", {}, "Candidate effects that were tried"), ...table)] : table),
    ...[limits(found)].filter(Boolean));
}

export const legend = () => element("p", { class: "legend" },
  element("span", {}, element("i", { class: "fit-key", style: { background: "var(--accent)" } }), "in the fit"),
  element("span", {}, element("i", { style: { background: "var(--good)" } }), "on views left out"),
  element("span", {}, "┆ noise floor"));

// Two bars on one scale, with the noise floor.
export function bars(fit, out, most, floor) {
  const width = x => `${Math.min(100, 100 * (x ?? 0) / most)}%`;
  return element("div", { class: "track" }, element("span", { class: "fit", style: { width: width(fit) } }),
    element("span", { class: "out", style: { width: width(out) } }), element("span", { class: "floor", style: { left: width(floor) } }));
}

const numbers = (fit, out) => `${um(fit)}, ${um(out)} on views left out`;

function row(name, fit, out, most, floor) {
  return element("tr", {}, element("td", {}, name),
    element("td", { class: "bars", "aria-label": numbers(fit, out) }, bars(fit, out, most, floor)), element("td", {}), element("td", {}));
}

function candidate(c, found, state, most, ask, busy) {
  const named = found.named.includes(c.effect);
  // What is named stands above the page.
  const add = named ? "" : element("button", { type: "button", disabled: busy, "aria-label": `Add ${c.effect}`,
    title: `stitch add ${state.run} ${c.effect}`, onclick: () => { foresee("add", c.effect); ask({ kind: "add", effects: [c.effect] }); } }, "Add");
  const look = state.pictured.includes(c.effect) && element("button", { type: "button", "aria-label": `Show the part as ${c.effect} should leave it`,
    onclick: () => { predict(c.effect); why(found.courses[c.effect], state); } }, "Show");
  return [
    element("tr", { class: named ? "best" : "" }, element("td", {}, c.effect + (c.own ? " (your own)" : "")),
      element("td", { class: "bars", "aria-label": numbers(c.rms_if_added, c.heldout_if_added) },
        c.rms_if_added == null ? "–" : bars(c.rms_if_added, c.heldout_if_added, most, state.floor)),
      element("td", {}, c.posterior), element("td", {}, look || "", " ", add)),
    element("tr", {}, element("td", { class: "wide", colspan: "4" },
      [c.is, numbers(c.rms_if_added, c.heldout_if_added), signed(c.amounts), signed(`p = ${c.p}`), c.aliases.length && `aliases: ${c.aliases.join(", ")}`].filter(Boolean).join("; "))),
  ];
}

// Why: every view along what an effect does, and what it predicts; a dot chooses its view.
function why(course, state, named = true) {
  const root = at("why");
  root.hidden = !course;
  if (!course) return;
  const plot = window.coursePlot(course, state.view_names, state.um, named);
  root.querySelector("h3").textContent = plot.title;
  window.xyPlot(root.querySelector("div"), plot.spec, 220, i => chooseView(i < 0 ? -1 : course.views[i] ?? -1));
}

function limits(found) {
  const told = [];
  if (found.follows.length) told.push(`What is left follows ${found.follows.slice(0, 3).map(f => `${f.covariate} (p = ${signed(f.p)})`).join(", ")}.`);
  if (found.unseen.length) told.push(`These views cannot show: ${found.unseen.join(", ")}.`);
  for (const u of found.untested) told.push(`Not tested without ${u.needs.join(", ")}: ${u.effect}.`);
  for (const n of found.next) told.push(`To measure next: ${n.do} (separates ${n.separates.join(" and ")}).`);
  return told.length ? element("details", {}, element("summary", {}, "What could not have been seen, and what to measure next"), ...told.map(t => element("p", {}, t))) : null;
}
