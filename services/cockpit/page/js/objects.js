// How an object looks in lists and on the map: its shape, and the colour that its name tells.
const SHADES = {
  red: "#d0312d", green: "#2f9e44", blue: "#2f5fd0", yellow: "#e0b400", orange: "#e8710a", purple: "#8344c5", pink: "#d6589a",
  brown: "#8a5a34", black: "#22262a", white: "#f2f2f2", grey: "#8b9196", gray: "#8b9196",
}; // prettier-ignore
const SVG = "http://www.w3.org/2000/svg";

/** The label of what is in the hand by a message `state`; "" where nobody knows its label, null where nothing is there. */
export function held({ task, plan }) {
  if (!plan?.holding) return null;
  return plan.target ?? (task?.task === "fetch" && task.outcome === "done" ? task.label : "");
}

/** The colour in an object's name; null without one. */
export function shade(label) {
  const word = label.split(/[-_ ]/).find((part) => part in SHADES);
  return word ? SHADES[word] : null;
}

/** A small picture of an object: cylinder, sphere or box. */
export function swatch({ label, shape }) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("class", "swatch");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const part = document.createElementNS(SVG, shape === "sphere" ? "circle" : "rect");
  const places = {
    sphere: { cx: 12, cy: 12, r: 9 },
    cylinder: { x: 6, y: 2, width: 12, height: 20, rx: 4 },
    box: { x: 3, y: 4, width: 18, height: 16, rx: 2 },
  };
  for (const [name, value] of Object.entries(places[shape] ?? places.box)) part.setAttribute(name, value);
  part.setAttribute("fill", shade(label) ?? "currentColor");
  svg.append(part);
  return svg;
}
