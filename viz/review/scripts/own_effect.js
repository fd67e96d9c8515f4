// An effect of the reviewer's own: typed, consented to, checked, tried as one more candidate effect.
import { at, element } from "./elements.js";
import { send } from "./server.js";

const EXAMPLE = `from stitch.effects import effect, number


@effect("sensor", needs=["humidity_percent"], k=number("mm", typical=0.02, limit=1.0))
def humidity_bias(points, view, k):
    """x = x* + u·k·(humidity − first humidity)"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
`;
let filled = false, mine = null, model = null;

export function showOwn(state) {
  if (model && model !== state.model && !mine) at("own-told").textContent = "";  // it spoke of the model before
  model = state.model;
  if (!filled) { at("own").value = state.own || EXAMPLE; filled = true; }
  const box = at("consent");
  box.hidden = !state.trust;
  if (!state.trust) return;
  box.replaceChildren(element("div", { class: "note" },
    element("p", {}, `The model names effects in ${state.trust.file}: Python that would be run with your rights. Until you allow it, nothing can be computed here.`),
    element("details", {}, element("summary", {}, "Read it"), element("pre", { tabindex: "0" }, state.trust.text)),
    element("button", { type: "button", onclick: () => send("trust", { trust: true }) }, "I have read it; it may be run")));
}

export function heardOwn(job) {
  if (!mine || job.number !== mine || ["waiting", "running"].includes(job.state)) return;
  const told = job.lines.filter(line => line.startsWith("stitch: ")).pop();
  at("own-told").className = job.state === "done" ? "" : "failed";
  at("own-told").textContent = job.state !== "done" ? (told || "It did not end well; see the commands below.")
    : job.kind === "effects" ? "It is an effect: place, parameters and form are as they have to be. What it explains, a try tells." : "Tried: it stands among the candidate effects above.";
  mine = null;
}

async function ask(diagnose) {
  at("own-told").className = "";
  at("own-told").textContent = diagnose ? "Being tried …" : "Being checked …";
  try {
    mine = (await send("own", { text: at("own").value, trust: at("own-trust").checked, diagnose })).number;
  } catch (error) {
    at("own-told").className = "failed"; at("own-told").textContent = error.message;
  }
}

const consent = () => { for (const id of ["own-check", "own-try"]) at(id).disabled = !at("own-trust").checked; };
at("own-trust").addEventListener("change", consent);
// What was consented to is this text, not another.
at("own").addEventListener("input", () => { at("own-trust").checked = false; consent(); });
at("own-check").addEventListener("click", () => ask(false));
at("own-try").addEventListener("click", () => ask(true));
