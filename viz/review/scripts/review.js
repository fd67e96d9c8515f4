// The review: reads the run as it stands, and draws it anew whenever it changes, whoever changed it.
import { showCandidates } from "./candidates.js";
import { at, unbroken } from "./elements.js";
import { showLedger } from "./ledger.js";
import { heardOwn, showOwn } from "./own_effect.js";
import { chooseOnPart, showPlots } from "./plots.js";
import { showRecording } from "./recording.js";
import { markOf, onPick, show, showNumbers } from "./scene.js";
import { listen, read, send } from "./server.js";
import { showAnswer, showScreen, showSteps } from "./steps.js";
import * as work from "./work.js";

let state = null, version = null, reading = false, again = false;

async function refresh() {
  if (reading) { again = true; return; }
  reading = true;
  try {
    const next = await read("state");
    version = next.version;
    problem(next.problem);
    if (!next.problem) { state = next; await draw(); prepare(); }
  } catch (error) {
    problem(error.message);
  } finally {
    reading = false;
    if (again) { again = false; refresh(); }
  }
}

async function draw() {
  at("name").textContent = `Review of ${state.name}`;
  const found = state.diagnosis && state.diagnosis.headline ? state.diagnosis : null;
  at("sentence").textContent = unbroken(found ? found.headline : state.sentence);
  at("evidence").textContent = unbroken(found ? `${found.proof} ${found.certainty}` : state.evidence === state.sentence ? "" : state.evidence);
  showScreen(version);
  await show(state);
  showNumbers(state);
  showPlots(state);
  showOwn(state);
  showRecording(state);
  controls();
}

function controls() {
  if (!state) return;
  const busy = work.busy() || Boolean(state.trust);
  showSteps(state, ask, busy);
  showCandidates(state, ask, busy);
  showLedger(state, ask, busy);
}

// What a run folder lacks for its plots is made by a command, once for a model.
const prepared = new Set();
function prepare() {
  if (state.trust || prepared.has(state.model)) return;
  prepared.add(state.model);
  if (state.outdated) ask({ kind: "report" });
  if (!state.comparison) ask({ kind: "compare" });
}

async function ask(command) {
  try {
    await send("jobs", { ...command, model: state.model });
    problem(null);
  } catch (error) {
    problem(error.message);
  }
}

function problem(text) {
  at("problem").hidden = !text;
  at("problem").textContent = text || "";
}

let silent = false;
function lost(text) { silent = true; problem(text); }

listen(event => {
  if (silent) { silent = false; problem(null); }
  if (event.type === "trusted" || event.type === "changed" && event.version !== version) refresh();
  if (event.type === "job") {
    const before = work.heard(event.job);
    heardOwn(event.job);
    showAnswer(event.job);
    if (before !== event.job.state) controls();
  }
}, () => lost("The server does not answer; is `stitch review` still running? This page asks again by itself."));

onPick((place, patch) => chooseOnPart(place, markOf(patch)));
at("note-form").addEventListener("submit", async event => {
  event.preventDefault();
  await ask({ kind: "note", text: at("note").value, by: at("by").value });
  at("note").value = "";
});
