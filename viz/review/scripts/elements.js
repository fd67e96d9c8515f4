// Elements and numbers: small words that every other script uses.

// An element with attributes and children; "on…" are listeners, "style" an object.
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(made.style, value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value != null) made.setAttribute(name, value);
  }
  const typed = ["code", "pre"].includes(tag);  // what may be copied into a terminal stays as it is
  made.append(...children.filter(child => child != null && child !== false).map(child => typeof child === "string" && !typed ? unbroken(child) : child));
  return made;
}

// Signs of numbers as signs, which no line breaks after: −2e−07, not -2e- 07.
export const signed = text => text.replace(/(^|[\s=(±])-(?=\d)/g, "$1−").replace(/(\d)e-(?=\d)/g, "$1e−");

// No-break spaces before units, about ± and =, as viz/unbroken.py sets them on the page of a run.
export const unbroken = text => text.replace(/(?<=\d) (?=(?:[kµm]?m|[µm]?rad|N|kg|°C?|deg|ppm|h|min|m?s|[kM]B|[%σ])(?![\w%])|± \d)|(?<=\d ±) (?=\d)|(?<=\bN) (?=m\b)|(?<=\w) (?== [−-]?\d)|(?<=\w =) (?=[−-]?\d)/g, "\u00a0");

export const at = id => document.getElementById(id);

// Three digits, as the page of a run has them.
export const digits = x => x == null ? "–" : x === 0 ? "0" : Number(x.toPrecision(3)).toString().replace("-", "−");
// Millimetres above one, micrometres below.
export const um = x => x == null ? "–" : Math.abs(x) >= 999.5 ? `${digits(x / 1e3)} mm` : `${digits(x)} µm`;
