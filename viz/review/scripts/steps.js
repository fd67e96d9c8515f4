// What can be done now, above the page of the run: add, group, explain, the next pose; and the page as it stands.
import { at, element } from "./elements.js";
import { foresee } from "./scene.js";

// `ask` sends a command; `busy` while one that changes the run is under way.
export function showSteps(state, ask, busy) {
  const found = state.diagnosis, verdict = found && found.verdict;
  // The main button is the command that the page's Next names.
  const advised = found ? found.advised : "diagnose";
  const step = (text, command, before) => {
    const press = () => { if (before) before(); ask(command); };
    const main = command.kind === advised && command.effects?.[0] === (advised === "add" ? found.named[0] : undefined);
    return element("button", { type: "button", class: main ? "main" : "", disabled: busy, onclick: press }, text);
  };
  const add = effect => step(`Add ${effect}`, { kind: "add", effects: [effect] }, () => foresee("add", effect));
  at("steps").replaceChildren(...[
    !found && step("Find what is missing", { kind: "diagnose" }),
    verdict === "cannot_tell" && step("Next pose", { kind: "next" }),
    ...(["missing_effect", "cannot_tell"].includes(verdict) ? found.named.map(add) : []),
    found && [advised, found.instead].includes("group") && step("Add as a group", { kind: "group" }),
    verdict === "unknown_effect" && step("Explain", { kind: "explain" }),
    ["missing_effect", "unknown_effect"].includes(verdict) && step("Next pose", { kind: "next" }),
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
