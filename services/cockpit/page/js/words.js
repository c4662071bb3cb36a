// The texts of the page in the language that the person reads. No text is in a module: each has a name in words/*.json.
import { kept, keep } from "./kept.js";

export const LANGUAGES = ["en", "de"];
let words = {};
let language = "en";

/** The language that was chosen here before, else the first of the browser's that there is, else English. */
export function preferred() {
  const asked = [kept("language"), ...(navigator.languages ?? [])].map((name) => (name ?? "").slice(0, 2).toLowerCase());
  return asked.find((name) => LANGUAGES.includes(name)) ?? "en";
}

/** Load a language and write its texts into the page. */
export async function speak(name, { remember = false } = {}) {
  const answer = await fetch(`/static/words/${name}.json`);
  words = await answer.json();
  language = name;
  document.documentElement.lang = name;
  if (remember) keep("language", name);
  write(document);
}

/** The text of that name, with `{x}` replaced by `values.x`; the name itself where there is no such text. */
export function say(name, values = {}) {
  return (words[name] ?? name).replace(/\{(\w+)\}/g, (whole, key) => values[key] ?? whole);
}

/** The text of that name, else the other text. */
export function sayOr(name, other) {
  return words[name] ?? other;
}

/** What an object, a task or a phase is called for people: its own text, else its name in words. */
export function called(kind, name) {
  const plain = String(name ?? "").replace(/[-_]/g, " ");
  return sayOr(`${kind}s.${name}`, kind === "object" ? plain : plain.charAt(0).toUpperCase() + plain.slice(1));
}

export function number(value, digits = 1) {
  return new Intl.NumberFormat(language, { minimumFractionDigits: digits, maximumFractionDigits: digits }).format(value);
}

/** Metres, as exactly as a person needs them. */
export function metres(value) {
  return `${number(value, value < 10 ? 1 : 0)} m`;
}

/** Seconds as `4 s`, `3:20 min`, `2 h`. */
export function span(seconds) {
  if (seconds < 60) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")} min`;
  return seconds < 172800 ? `${Math.round(seconds / 3600)} h` : `${Math.round(seconds / 86400)} d`;
}

export function bytes(size) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let step = 0;
  for (; size >= 1000 && step < units.length - 1; step++) size /= 1000;
  return `${number(size, step > 1 && size < 100 ? 1 : 0)} ${units[step]}`;
}

/** A Unix time as date and time of day. */
export function moment(seconds) {
  return new Intl.DateTimeFormat(language, { dateStyle: "medium", timeStyle: "short" }).format(new Date(seconds * 1000));
}

/** Write the texts of `data-word` and the labels of `data-label` within that part of the page. */
export function write(root) {
  for (const part of root.querySelectorAll("[data-word]")) part.textContent = say(part.dataset.word);
  for (const part of root.querySelectorAll("[data-label]")) part.setAttribute("aria-label", say(part.dataset.label));
}
