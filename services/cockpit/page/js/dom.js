// Making and changing elements. Text of the robot only ever becomes text, never markup.
const SVG = "http://www.w3.org/2000/svg";

export const the = (id) => document.getElementById(id);

/** A new element with these attributes and children. A value of null leaves an attribute out; `on...` is a listener. */
export function make(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** A picture of lines: `paths` are the d attributes of its paths. */
export function drawing(...paths) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  for (const d of paths) {
    const path = document.createElementNS(SVG, "path");
    path.setAttribute("d", d);
    svg.append(path);
  }
  return svg;
}

/** Set a text only when it changes: a screen reader and the layout are left alone otherwise. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set or remove an attribute, only when it changes. */
export function mark(element, name, value) {
  if (value === null || value === undefined || value === false) element.removeAttribute(name);
  else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value === true ? "" : value);
}

let probe = null;
const colours = new Map();

/** The computed value of a colour of the style sheet, for canvases. */
export function colour(name) {
  if (!colours.has(name)) {
    if (!probe) {
      probe = make("i", { hidden: true });
      document.body.append(probe);
    }
    probe.style.color = `var(--${name})`;
    colours.set(name, getComputedStyle(probe).color);
  }
  return colours.get(name);
}

/** To be called when the theme changed. */
export function forgetColours() {
  colours.clear();
}

/** Give the canvas as many pixels as the screen has there. Returns its size in CSS pixels, and pixels per CSS pixel. */
export function fitted(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  const [x, y] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== x || canvas.height !== y) [canvas.width, canvas.height] = [x, y];
  return { width, height, ratio };
}

/** The size of 1 rem in CSS pixels: what is drawn on canvases grows with the screen, too. */
export function rem() {
  return parseFloat(getComputedStyle(document.documentElement).fontSize);
}
