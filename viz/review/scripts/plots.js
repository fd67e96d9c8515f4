// Where it fails: a small plot for each property. What is chosen in one changes part and numbers.
import { at, digits, element, signed, um } from "./elements.js";
import { back, onShown, showChoice } from "./scene.js";
import { send } from "./server.js";

// More bars than this are thinner than a finger, and slow.
const FIRST = 5, MOST = 60, VIEWS = "view", TARGETS = "target", PLACES = "place on the part";
let choice = empty(), state = null, all = false, asked = 0;

function empty() { return { views: [], targets: [], bins: {}, place: null, within: 0, name: "" }; }

// Draw the plots of a state; a choice of another model is forgotten.
export function showPlots(next) {
  const same = state && state.model === next.model && state.comparison;
  state = next;
  if (!same) { choice = empty(); numbers(null); }
  draw();
}

export function choosePlace(place, within = 0, name = "a place of the part") {
  choice.place = place; choice.within = within; choice.name = place ? name : "";
  draw(); ask();
}

// A view by its number in the run, from a dot of another plot; again, and all count.
export function chooseView(index) {
  choice.views = index < 0 ? [] : [state.view_names[index]];
  draw(); ask();
}

// A click on the part: a place of it, or among labelled points the view or the target that stands there.
export function chooseOnPart(place, mark) {
  if (!mark) { choosePlace(place); return; }
  if (mark.view) choice.views = toggled(choice.views, mark.view);
  else if (mark.target) choice.targets = toggled(choice.targets, mark.target);
  draw(); ask();
}

const toggled = (names, name) => names.includes(name) ? names.filter(n => n !== name) : [...names, name];

function draw() {
  const root = at("plots");
  if (!state.comparison) {
    root.style.minHeight = `${root.offsetHeight}px`;  // what stands below stays where it is
    root.replaceChildren(element("p", { class: "soft" }, "The residual is being compared with everything known of it …"));
    return;
  }
  root.style.minHeight = "";
  const found = state.diagnosis ? state.diagnosis.follows : [], follows = found.map(f => f.table);
  const rank = table => follows.includes(table.name) ? follows.indexOf(table.name) - 100 : -table.clearest;
  const properties = state.comparison.filter(t => !t.label.length && t.low.length > 1).sort((a, b) => rank(a) - rank(b));
  const shown = all ? properties : properties.slice(0, FIRST);
  const focus = document.activeElement && document.activeElement.dataset.key;
  const parts = [named(VIEWS, "Views", "views", state.labelled ? "rms of the labelled points of each" : "rms of each against the others"),
    named(TARGETS, "Targets", "targets", "rms of each over the views"), ...shown.map(table => plot(table, found.find(f => f.table === table.name))), places(),
    properties.length > FIRST && element("button", { type: "button", onclick: () => { all = !all; draw(); }, "aria-expanded": String(all) },
      all ? "Fewer properties" : `${properties.length - FIRST} further properties`)];
  root.replaceChildren(...parts.filter(Boolean));
  if (focus) root.querySelector(`[data-key="${CSS.escape(focus)}"]`)?.focus();
}

// A bar for every view, or for every target.
function named(name, title, key, what) {
  const table = state.comparison.find(t => t.name === name);
  if (!table || table.label.length < 2) return "";
  const rms = Object.fromEntries(table.label.map((label, i) => [label, table.rms[i] ?? 0]));
  const worst = new Set([...table.label].sort((a, b) => rms[b] - rms[a]).slice(0, MOST));
  const shown = table.label.filter(label => worst.has(label)), most = Math.max(...shown.map(label => rms[label]), 1e-9);
  const few = shown.length < table.label.length ? `: the ${shown.length} farthest off of ${table.label.length}` : "";
  return card(title, `${what}, up to ${um(most)}${few}`, "wide", shown.map((label, i) => bar({
    key: `${name} ${label}`, height: rms[label] / most, from: 0, pressed: choice[key].includes(label),
    label: `${name} ${label}: rms ${um(rms[label])}`,
    toggle: range => {
      const before = choice[key], last = shown.indexOf(before[before.length - 1]);
      const span = range && last >= 0 ? shown.slice(Math.min(i, last), Math.max(i, last) + 1) : [];
      choice[key] = span.length ? [...new Set([...before, ...span])] : toggled(before, label);
    },
  })), shown[0], shown[shown.length - 1]);
}

function plot(table, follows) {  // `follows` where the diagnosis says that what is unexplained follows it
  const spread = table.mean_sigma.map(x => 2 * (x ?? 0));
  const most = Math.max(...table.mean.map((x, i) => Math.abs(x ?? 0) + spread[i]), 1e-9);
  const unit = table.unit ? ` ${table.unit}` : "", chosen = choice.bins[table.name];
  const told = (follows ? `what is unexplained follows it (p = ${signed(follows.p)}); ` : "")
    + (table.name.startsWith("approach of ") ? "−1: it last turned down, +1: up; " : "");
  return card(`${table.name}${table.unit ? ` (${table.unit})` : ""}`, `${told}signed mean ± 2σ, within ±${um(most)}`, "", table.mean.map((mean, i) => bar({
    key: `${table.name} ${i}`, height: (mean ?? 0) / most / 2, from: 0.5, spread: spread[i] / most / 2,
    pressed: Boolean(chosen && chosen[0] <= i && i <= chosen[1]),
    label: `${table.name} from ${digits(table.low[i])} to ${digits(table.high[i])}${unit}: mean ${um(mean)} ± ${um(table.mean_sigma[i])}, rms ${um(table.rms[i])}, ${table.views[i]} views`,
    toggle: range => {
      if (range && chosen) choice.bins[table.name] = [Math.min(i, chosen[0]), Math.max(i, chosen[1])];
      else if (chosen && chosen[0] === i && chosen[1] === i) delete choice.bins[table.name];
      else choice.bins[table.name] = [i, i];
    },
  })), digits(table.low[0]), digits(table.high[table.high.length - 1]), true);
}

function card(title, words, kind, bars, low, high, zero = false) {
  return element("div", { class: `plot ${kind}`, role: "group", "aria-label": title },
    element("h3", {}, title), element("p", { class: "soft" }, words),
    element("div", { class: "bins" }, ...bars, zero && element("div", { class: "zero", style: { top: "50%" } })),
    element("div", { class: "ends" }, element("span", {}, low), element("span", {}, high)));
}

function bar({ key, height, from, spread = 0, pressed, label, toggle }) {
  const share = x => `${100 * x}%`, low = Math.min(height, 0), size = Math.abs(height);
  return element("button", {
    type: "button", "data-key": key, "aria-pressed": String(pressed), "aria-label": label, title: label,
    onclick: event => { toggle(event.shiftKey); draw(); ask(); },
  }, element("i", { style: { bottom: share(from + low), height: share(size) } }),
  spread > 0 && element("u", { style: { bottom: share(Math.max(0, from + height - spread)), height: share(Math.min(1, 2 * spread)) } }));
}

function places() {
  const table = state.comparison.find(t => t.name === PLACES);
  if (!table || !state.part) return "";
  const fair = table.count.map((n, i) => [n, i]).filter(([n]) => n > 50).map(([, i]) => i);
  const worst = fair.sort((a, b) => table.rms[b] - table.rms[a]).slice(0, 4);
  return element("div", { class: "plot", role: "group", "aria-label": "Places of the part" },
    element("h3", {}, "Places of the part"), element("p", { class: "soft" }, `where it is worst; x, y, z in ${state.length_unit}, reference frame`),
    element("div", { class: "places" }, ...worst.map(i => {
      const place = table.label[i].replace(/[()]/g, "").split(",").map(Number);
      const pressed = Boolean(choice.place) && place.every((x, k) => x === choice.place[k]);
      return element("button", { type: "button", "data-key": `place ${i}`, "aria-pressed": String(pressed),
        onclick: () => pressed ? choosePlace(null) : choosePlace(place, 0, `the place ${table.label[i].replaceAll("-", "−")}`) },
      `${table.label[i].replaceAll("-", "−")}: ${um(table.rms[i])}`);
    })));
}

function words() {
  const out = Object.entries(choice.bins).map(([name, [first, last]]) => {
    const table = state.comparison.find(t => t.name === name);
    return `${name} ${digits(table.low[first])} … ${digits(table.high[last])} ${table.unit}`.trim();
  });
  for (const [key, one] of [["views", ""], ["targets", "target "]]) {
    if (choice[key].length) out.push(choice[key].length > 3 ? `${choice[key].length} ${key}` : one + choice[key].join(", "));
  }
  if (choice.place) out.push(choice.name);
  return out.join(" · ");
}

// Ask for the field of the choice; an answer that comes after a later question is not shown.
async function ask() {
  const mine = ++asked, name = words();
  if (!name) { showChoice("", null); numbers(null); return; }
  at("chosen").setAttribute("aria-busy", "true");
  try {
    const { views, targets, bins, place, within } = choice;
    const told = await send("chosen", { views, targets, bins, place, within });
    if (mine !== asked) return;
    if (told.model !== state.model) return;
    showChoice(name, told); numbers(name, told);
  } catch (error) {
    if (mine === asked) numbers(name, null, error.message);
  }
}

// The numbers speak of what the picture shows: of a view or a candidate effect too, until one goes back to the choice.
let chosenNumbers = () => numbers(null);
onShown(({ kind, text, means }) => {
  if (kind !== "v" && kind !== "c") { chosenNumbers(); return; }
  const name = words(), button = element("button", { type: "button", onclick: back }, name ? `Back to ${name}` : "Show all again");
  const told = kind === "v" ? "This view alone; choose its bar for its numbers."
    : `${um(means[0])} on average over the part as it is, ${um(means[1])} if it were added, in the linear approximation: all views, all places.`;
  at("chosen").replaceChildren(button, element("p", {}, element("b", {}, kind === "v" ? `Shown: ${text}` : `P${text.slice(1)}`)), element("p", {}, told));
});

function numbers(name, told, problem) {
  const root = at("chosen");
  chosenNumbers = () => numbers(name, told, problem);
  root.removeAttribute("aria-busy");
  if (!name) { root.replaceChildren(element("p", { class: "soft" }, "Nothing is chosen: all views and all places count.")); return; }
  const clear = element("button", { type: "button", onclick: () => { choice = empty(); draw(); ask(); } }, "Show all again");
  if (problem || !told.chosen.correspondences) {
    root.replaceChildren(clear, element("p", {}, `Chosen: ${name}`), element("p", {}, problem || "No correspondence lies there."));
    return;
  }
  const { chosen, all } = told;
  root.replaceChildren(clear, element("p", {}, element("b", {}, `Chosen: ${name}`)),
    element("p", {}, `${chosen.views} of ${all.views} views, ${chosen.correspondences.toLocaleString("en")} residuals: rms ${um(chosen.rms)} (all: ${um(all.rms)})`
      + (chosen.mean == null ? "" : `, on average over the part ${um(chosen.mean)} (all, by the same patches: ${um(all.mean)})`)
      // Both sides of every correspondence count: without a choice among them the mean is zero.
      + (Math.abs(chosen.signed ?? 0) < 1e-6 ? "." : `, signed mean ${um(chosen.signed)}.`)));
}
