// The error, step by step: a step for every change of the model, its remarks, undo and redo.
import { bars, legend } from "./candidates.js";
import { at, element, signed, um } from "./elements.js";
import { foresee } from "./scene.js";

let drawn = 0;

export function showLedger(state, ask, busy) {
  const most = Math.max(...state.ledger.map(s => Math.max(s.residual, s.heldout ?? 0)), 1e-9);
  const steps = state.ledger.map((step, i) => {
    const track = bars(step.residual, step.heldout, most, step.floor);
    if (drawn && i >= drawn && i > 0) fall(track, state.ledger[i - 1], step, most);
    return element("div", { class: "step", role: "listitem" },
      element("div", { class: "line" }, element("b", {}, step.change), element("span", {}, `${um(step.residual)}, ${um(step.heldout)} on views left out`)), track,
      ...step.notes.map(n => element("p", { class: "remark" }, n.text, element("span", { class: "soft" }, ` — ${[n.by, n.at.slice(0, 16).replace("T", " ")].filter(Boolean).join(", ")}`))));
  });
  drawn = state.ledger.length;
  at("ledger").replaceChildren(legend(), element("div", { role: "list" }, ...steps));
  for (const kind of ["undo", "redo"]) {
    const change = state.history[kind], button = at(kind), word = kind === "undo" ? "Undo" : "Redo";
    button.disabled = busy || !change;
    button.textContent = change ? `${word}: ${change.command} ${change.effects.join(", ")}` : word;
    button.onclick = () => {
      foresee(change.command === "add" ? "add" : "back", change.effects[0]);
      ask({ kind });
    };
  }
  parameters(state.effects, state.in_words);
}

// A new step's bars begin where those of the step before ended.
function fall(track, before, step, most) {
  [[".fit", before.residual, step.residual], [".out", before.heldout, step.heldout]].forEach(([kind, from, to]) => {
    const bar = track.querySelector(kind);
    bar.style.width = `${100 * (from ?? 0) / most}%`;
    requestAnimationFrame(() => requestAnimationFrame(() => { bar.style.width = `${100 * (to ?? 0) / most}%`; }));
  });
}

function parameters(rows, names) {
  if (!rows.length) return;
  at("ledger").append(element("details", {}, element("summary", {}, `Effects in the model: ${names.join(", ")}`),
    ...rows.map(r => element("p", {}, signed(`${r.effect}.${r.parameter} = ${r.value} ± ${r.sigma} ${r.unit}`)))));
}
