// What can be done now, above the page of the run: add, group, explain, the next pose; and the page as it stands.
import { at, element } from "./elements.js";
import { foresee } from "./scene.js";

// `ask` sends a command; `busy` while one that changes the run is under way.
export function showSteps(state, ask, busy) {
  const found = state.diagnosis, naming = found && ["missing_effect", "cannot_tell"].includes(found.verdict), advisesGroup = naming && found.verdict === "cannot_tell";
  const step = (text, command, main, before) => element("button", { type: "button", class: main ? "main" : "", disabled: busy, onclick: () => { if (before) before(); ask(command); } }, text);
  const adds = naming ? found.named.map((effect, i) => step(`Add ${effect}`, { kind: "add", effects: [effect] }, i === 0 && !advisesGroup, () => foresee("add", effect))) : [];
  at("steps").replaceChildren(...[
    !found && step("Find what is missing", { kind: "diagnose" }, true),
    ...adds,
    advisesGroup && step("Add as a group", { kind: "group" }, true),
    found && found.verdict === "unknown_effect" && step("Explain", { kind: "explain" }, true),
    found && found.verdict !== "adequate" && step("Next pose", { kind: "next" }),
  ].filter(Boolean));
  at("to-note").onclick = () => at("note").focus();
}

let shown = null;
// The frame is read anew where the run, or what a diagnosis says of it, has changed.
export function showScreen(version) {
  if (version === shown) return;
  shown = version;
  at("screen").src = `screen?${encodeURIComponent(version)}`;
}

// What a command answered that changes nothing: where to drive next, a formula.
export function showAnswer(job) {
  const asked = ["next", "explain"].includes(job.kind) && job.state === "done";
  if (!asked) return;
  at("answer").hidden = false;
  at("answer").textContent = [job.command, ...job.lines].join("\n");
}
