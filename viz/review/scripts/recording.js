// The recording in the Rerun viewer, loaded when it is opened, and anew for another model.
import { at, element } from "./elements.js";

const details = at("recording-details");
let shown = null, model = null;

export function showRecording(state) {
  at("recording").hidden = !state.recording;
  model = state.recording ? state.model : null;
  at("recording-alone").href = address();
  load();
}

function address() {
  const data = new URL(`rerun/recording.rrd?${encodeURIComponent(model)}`, document.baseURI).href;
  return `rerun/index.html?url=${encodeURIComponent(data)}&renderer=webgl&hide_welcome_screen`;
}

function load() {
  if (!details.open || !model || shown === model) return;
  shown = model;
  at("recording-frame").replaceChildren(element("iframe", { src: address(), title: "The recording in the Rerun viewer" }));
}

details.addEventListener("toggle", load);
