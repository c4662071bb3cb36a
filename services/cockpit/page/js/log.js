// The newest lines of all logs, while the panel is open.
import { make, the } from "./dom.js";
import { say } from "./words.js";

const MOST = 400;
const SHOWN = { all: [], warnings: ["debug", "info"] };
let only = "all";

/** Take a message `log`. */
export function takeLog({ lines }) {
  const list = listed();
  const panel = the("log");
  const atEnd = panel.scrollHeight - panel.scrollTop - panel.clientHeight < 40;
  for (const line of lines) list.append(shown(line));
  while (list.children.length > MOST) list.firstElementChild.remove();
  if (atEnd) panel.scrollTop = panel.scrollHeight;
}

/** The choice of lines, for the panel's head. */
export function logChoice() {
  const choose = (name) => {
    only = name;
    for (const button of box.children) button.setAttribute("aria-pressed", String(button.dataset.only === only));
    for (const line of listed().children) line.hidden = SHOWN[only].includes(line.dataset.level);
  };
  const buttons = Object.keys(SHOWN).map((name) =>
    make("button", { type: "button", "data-only": name, "aria-pressed": String(name === only), onclick: () => choose(name) }, say(`log.${name}`)),
  );
  const box = make("div", { class: "choice", role: "group", "aria-label": say("log.shown") }, ...buttons);
  return box;
}

function listed() {
  const panel = the("log");
  if (!panel.querySelector(".lines")) panel.append(make("ol", { class: "lines" }));
  return panel.querySelector(".lines");
}

function shown({ t_ns: stampNs, level, service, text }) {
  const name = String(level).toLowerCase();
  const line = make(
    "li",
    { "data-level": name },
    make("time", {}, stampNs ? new Date(stampNs / 1e6).toTimeString().slice(0, 8) : ""),
    make("span", { class: "who" }, service),
    make("span", { class: "text" }, text),
  );
  line.hidden = SHOWN[only].includes(name);
  return line;
}
