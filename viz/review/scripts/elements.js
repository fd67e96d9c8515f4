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
  made.append(...children.filter(child => child != null && child !== false));
  return made;
}

// Signs of numbers as signs, which no line breaks after: −2e−07, not -2e- 07.
export const signed = text => text.replace(/(^|[\s=(±])-(?=\d)/g, "$1−").replace(/(\d)e-(?=\d)/g, "$1e−");

export const at = id => document.getElementById(id);

// Three digits, as the page of a run has them.
export const digits = x => x == null ? "–" : x === 0 ? "0" : Number(x.toPrecision(3)).toString().replace("-", "−");
// Millimetres above one, micrometres below.
export const um = x => x == null ? "–" : Math.abs(x) >= 999.5 ? `${digits(x / 1e3)} mm` : `${digits(x)} µm`;
