// The part: its viewer made anew for every model, with the eye where it was, fading from the old field to the new.
import { at, element, um } from "./elements.js";
import { read } from "./server.js";

const root = at("scene");
let viewer = null, model = null, diagnosed = null, marks = null;

// Show the part of a state; true if it was made anew. `fade`: from the model before to the present one.
export async function show(state) {
  words(state);
  if (!state.part) { root.classList.remove("live"); model = null; return false; }
  const mark = state.pictured.join() + (state.diagnosis ? state.diagnosis.plain + state.diagnosis.sentence : "");
  if (state.model === model && mark === diagnosed) return false;
  const told = await read("part");
  if (viewer && told.model === model) {
    diagnosed = mark;
    if (told.predicted) viewer.learn(told.predicted);
    return false;
  }
  const changed = model !== null && told.model !== model, eye = viewer && viewer.eye();
  if (viewer) viewer.stop();
  const old = root.querySelector("canvas"), fresh = old.cloneNode(false);
  const context = viewer && old.getContext("webgl2"), focused = document.activeElement === old;
  old.replaceWith(fresh);
  if (context) context.getExtension("WEBGL_lose_context")?.loseContext();
  if (focused) fresh.focus();
  viewer = window.showPart(root, told.part, told.predicted, eye);
  at("no-part").hidden = viewer !== null;
  at("no-part").textContent = "No picture: this browser has no WebGL.";
  model = told.model; diagnosed = mark; marks = told.part.marks || null;
  if (!viewer) return true;
  const last = Math.max(viewer.names().length - 2, 0);  // the present model; register comes after it
  viewer.jump(changed ? Math.max(last - 1, Math.min(told.part.begin ?? 0, last)) : last);  // never from the coarse hand-eye
  if (changed) viewer.glide(last);
  return true;
}

function words(state) {
  at("scene-title").textContent = state.labelled ? "The targets" : "The part";
  if (!state.labelled) return;
  const click = state.carried ? "A click on a ball chooses its view." : "A click on a ball chooses its target, on a pyramid its view.";
  at("fails-hint").textContent = `Choose bars, with Shift a range of them: colours and numbers follow, the rest is grey. ${click}`;
}

// What a change should bring, while its command runs: the prediction of an effect, or the model before.
export function foresee(kind, effect) {
  if (!viewer) return;
  if (kind === "add") { viewer.predict(effect); return; }
  const last = Math.max(viewer.names().length - 2, 0);
  viewer.show("all"); viewer.jump(last); viewer.glide(Math.max(last - 1, 0));
}

export const predict = name => viewer !== null && viewer.predict(name);
// View and target of a mark among labelled points, each null where it stands for all; null on a surface.
export const markOf = patch => marks && { view: marks[patch][0], target: marks[patch][1] };
export const back = () => viewer && viewer.back();
export const onShown = heard => root.addEventListener("shown", event => heard(event.detail));
export const onPick = heard => root.addEventListener("pick", event => heard(event.detail.place, event.detail.patch));

// The field of a choice beside that of everything; null takes it away.
export function showChoice(name, told) {
  if (!viewer) return;
  viewer.choose(name, told && [
    { name: "everything", mean: told.all.mean ?? told.all.rms, values: told.all.values },
    { name: "chosen", mean: told.chosen.mean ?? told.chosen.rms ?? 0, values: told.chosen.values },
  ]);
}

// The three numbers of a model, and how far they fell by its last step.
export function showNumbers(state) {
  const before = state.ledger.length > 1 ? state.ledger[state.ledger.length - 2] : null;
  const tile = (value, words, old) => element("div", { class: "tile" },
    element("b", {}, um(value)), element("small", {}, words), old != null && value != null && fell(value, old));
  at("tiles").replaceChildren(
    tile(state.residual, state.labelled ? "rms of labelled points, in the fit" : "rms between views, in the fit", before && before.residual),
    tile(state.heldout, "rms on held-out views", before && before.heldout),
    tile(state.floor, "noise floor of the sensor"));
}

function fell(value, old) {
  const share = Math.round(100 * (value / old - 1));
  return element("span", { class: share < 0 ? "fell" : share > 0 ? "rose" : "soft" }, `${share < 0 ? "−" : "+"}${Math.abs(share)} % from ${um(old)}`);
}
