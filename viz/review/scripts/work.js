// What is being done: the command that runs with its progress, and those that were run.
import { at, element, um } from "./elements.js";
import { send } from "./server.js";

const jobs = new Map();
const STATES = { waiting: "waits", running: "runs", done: "done", failed: "failed", stopped: "stopped" };
// What a command does that nobody asked for.
const UNASKED = {
  compare: "Measures where the views disagree, for the plots below; the model stays as it is: ",
  report: "Writes the page anew; the model stays as it is: ",
};
let begun = 0;

export const running = () => [...jobs.values()].find(j => j.state === "running") || [...jobs.values()].find(j => j.state === "waiting");
// While one of these runs nothing else can be asked for that depends on the model.
export const busy = () => [...jobs.values()].some(j => ["waiting", "running"].includes(j.state) && ["add", "group", "drop", "undo", "redo", "diagnose", "next", "explain"].includes(j.kind));

export function heard(job) {
  const before = jobs.get(job.number);
  jobs.set(job.number, job);
  if (job.state === "running") begun = performance.now() - 1000 * job.seconds;
  draw();
  log();
  return before ? before.state : null;
}

function draw() {
  const job = running(), now = at("now");
  now.classList.toggle("running", Boolean(job));
  at("stop").hidden = !job;
  at("bar").hidden = !job;
  if (!job) {
    const last = [...jobs.values()].pop();
    at("doing").textContent = !last ? "Nothing is running." : last.state === "failed" ? `Failed: ${last.command}: ${last.lines[last.lines.length - 1] || ""}`
      : `${last.state === "done" ? "Done" : "Stopped"}: ${UNASKED[last.kind] || ""}${last.command} (${Math.round(last.seconds)}\u00a0s)`;
    now.classList.toggle("failed", Boolean(last) && last.state === "failed");
    return;
  }
  now.classList.remove("failed");
  const seconds = job.state === "running" ? ` · ${Math.round((performance.now() - begun) / 1000)}\u00a0s` : " · waits";
  at("doing").textContent = `${UNASKED[job.kind] || ""}${job.command}${seconds}${told(job)}`;
  const share = shareOf(job);
  if (share === null) at("bar").removeAttribute("value"); else at("bar").value = share;
}

function told(job) {
  const last = job.progress[job.progress.length - 1];
  if (!last) return "";
  if (last.progress === "start") return ` · ${last.views} views read`;
  if (last.progress === "writing") return " · writing page and recording";
  return ` · ${last.progress}${last.iteration ? ` ${last.iteration}` : ""}${last.rms_um === undefined ? "" : `: ${um(last.rms_um)} rms`}`;
}

// Known only for what says where it stands: reading, coarse, fit, register, writing.
function shareOf(job) {
  const last = job.progress[job.progress.length - 1];
  if (!last) return null;
  const begin = { start: 0.05, coarse: 0.15, fit: 0.2, correct: 0.7, register: 0.75, fuse: 0.88, writing: 0.9 }[last.progress];
  return begin === undefined ? null : Math.min(0.95, begin + 0.08 * ((last.iteration || 1) - 1));
}

function log() {
  const open = new Set([...at("commands").querySelectorAll("details[open]")].map(d => d.dataset.number));
  at("commands").replaceChildren(...[...jobs.values()].map(job => element("li", {},
    element("code", {}, job.command), element("span", { class: job.state === "failed" ? "failed" : "soft" }, ` ${STATES[job.state]}${job.seconds ? `, ${job.seconds} s` : ""}`),
    job.lines.length ? element("details", { "data-number": job.number, open: open.has(String(job.number)) }, element("summary", {}, "what it said"), element("pre", { tabindex: "0" }, job.lines.join("\n"))) : null)));
}

setInterval(() => { if (running()) draw(); }, 1000);
at("stop").addEventListener("click", () => send("stop", {}));
