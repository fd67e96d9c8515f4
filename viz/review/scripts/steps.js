// What can be done now, above the page of the run: add, group, explain, the next pose, the hand-eye; and the page as it stands.
import { at, element } from "./elements.js";
import { foresee } from "./scene.js";

// `ask` sends a command; `busy` while one that changes the run is under way.
export function showSteps(state, ask, busy) {
  const found = state.diagnosis, verdict = found && found.verdict;
  // The main button is the command that the page's Next names.
  const advised = found ? found.advised : "diagnose";
  const step = (text, command, title, before) => {
    const press = () => { if (before) before(); ask(command); };
    const main = command.kind === advised && command.effects?.[0] === (advised === "add" ? found.named[0] : undefined);
    return element("button", { type: "button", class: main ? "main" : "", title, disabled: busy, onclick: press }, text);
  };
  const add = effect => step(`Add ${effect}`, { kind: "add", effects: [effect] }, "Adds it to the model and fits the same views anew.", () => foresee("add", effect));
  const next = () => step("Next pose", { kind: "next" }, "Says which view would tell most; the run stays as it is.");
  at("steps").replaceChildren(...[
    !found && step("Find what is missing", { kind: "diagnose" }, "Tries every known effect on what the poses leave; the model stays as it is."),
    verdict === "cannot_tell" && next(),
    ...(["missing_effect", "cannot_tell"].includes(verdict) ? found.named.map(add) : []),
    found && [advised, found.instead].includes("group") && step("Add as a group", { kind: "group" }, "Adds all of them, since these views cannot tell which."),
    verdict === "unknown_effect" && step("Explain", { kind: "explain" }, "Looks for a formula of what has no name; the run stays as it is."),
    ["missing_effect", "unknown_effect"].includes(verdict) && next(),
    verdict === "adequate" && step("Hand-eye for ROS", { kind: "export" }, "Shows the hand-eye as ROS takes it; the run stays as it is."),
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

// What a command answered that changes nothing: where to drive next, a formula, the hand-eye.
export function showAnswer(job) {
  const asked = ["next", "explain", "export"].includes(job.kind) && job.state === "done";
  if (!asked) return;
  at("answer").hidden = false;
  at("answer").textContent = [job.command, ...job.lines].join("\n");
}
