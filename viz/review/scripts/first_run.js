// From scans to their first run: guesses with what decides them, questions with their answers, then the commands.
import { at, element } from "./elements.js";
import { listen, send } from "./server.js";
import { heard } from "./work.js";

const BECAUSE = { file: "the files say so", scans: "the scans say so", usual: "only usual" };
let stated = {};

async function ask(options) {
  at("again").hidden = at("measure").hidden = true;
  at("sentence").textContent = "Reading the scans, trying conventions …";
  try {
    const told = await send("first", { options });
    stated = options;
    if (told.refused) refuse(told); else show(told);
  } catch (error) {
    at("sentence").textContent = error.message;
    at("asked").replaceChildren(element("p", { class: "soft" }, "Mend the folder, then load this page again."));
  }
}

// One way on is one button; a value in capitals is for a person to fill in.
function refuse({ refused, fixes }) {
  at("sentence").textContent = refused;
  at("asked").replaceChildren(...fixes.map(fix => {
    const fields = Object.entries(fix.options).map(([name, value]) => [name, value, value && value === value.toUpperCase() && /[A-Z]/.test(value)]);
    const inputs = fields.map(([name, value, open]) => open ? element("input", { name, placeholder: value, required: true, "aria-label": name }) : null);
    const go = event => {
      event.preventDefault();
      ask({ ...stated, ...Object.fromEntries(fields.map(([name, value], i) => [name, inputs[i] ? inputs[i].value.trim() : value])) });
    };
    return element("form", { onsubmit: go },
      element("p", {}, fix.words), fix.shows.length ? element("pre", {}, fix.shows.join("\n")) : null, ...inputs,
      fields.length ? element("button", { type: "submit" }, "Go on with this") : null);
  }));
}

function show({ views, guesses, not_used }) {
  const open = guesses.filter(guess => guess.because === "usual");
  at("sentence").textContent = !guesses.length ? "The folder is a session." : `${views} views. ${open.length ? `${open.length} of ${guesses.length} guesses are only usual: look at them.` : "Files and scans tell everything."}`;
  const rows = guesses.map(guess => element("tr", {}, element("td", { class: "words" }, `${guess.because === "usual" ? "? " : ""}${guess.what}`), element("td", { class: "fold" }, guess.because === "usual" ? answer(guess) : guess.value),
    element("td", { class: "words" }, BECAUSE[guess.because]), element("td", { class: "wide" }, guess.reason)));
  at("asked").replaceChildren(element("div", { class: "scroll" }, element("table", {}, ...rows)), not_used.length ? element("p", { class: "soft" }, `Not used: ${not_used.join("; ")}.`) : "");
  at("measure").hidden = false;
}

// What was taken, to be changed: for the runner-up where there is one, else in words of `stitch init`.
function answer({ what, value, runner_up, question }) {
  const [taken, ...others] = question.options, changed = () => { at("again").hidden = false; };
  const names = Object.keys(taken || {});
  const label = { "aria-label": what, onchange: changed };
  if (runner_up && others.length) {
    return element("select", { ...label, "data-options": "" }, ...question.answers.map((text, i) => element("option", { value: JSON.stringify(question.options[i]) }, text)));
  }
  return names.length === 1 ? element("input", { ...label, value: taken[names[0]], "data-option": names[0] }) : value;
}

const answers = () => [...at("asked").querySelectorAll("[data-options], [data-option]")].map(one => one.dataset.option ? { [one.dataset.option]: one.value.trim() } : JSON.parse(one.value));

at("again").addEventListener("click", () => ask(Object.assign({}, stated, ...answers())));
at("measure").addEventListener("click", async () => {
  at("measure").hidden = at("again").hidden = true;
  try { await send("measure", {}); } catch (error) { at("sentence").textContent = error.message; }
});
listen(event => {
  if (event.type !== "job") return;
  const before = heard(event.job);
  if (event.job.kind === "run" && event.job.state === "done" && before) location.reload();
  if (event.job.kind === "run" && event.job.state === "failed") at("sentence").textContent = event.job.lines.at(-1) || "It failed.";
  if (["failed", "stopped"].includes(event.job.state)) at("measure").hidden = false;
}, () => { at("doing").textContent = "The review has ended."; });
ask({});
