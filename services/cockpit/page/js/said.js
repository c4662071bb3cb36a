// What is said to the person: notices above STOP, and words for screen readers alone.
import { make, the } from "./dom.js";
import { say } from "./words.js";

const STAYS_MS = 9000;
const MOST = 3;

/** Show a notice. `action`: {text, run}, a button in it. */
export function notice(text, action = null) {
  const shown = the("notices");
  for (const former of [...shown.children]) if (former.dataset.text === text) former.remove();
  const close = () => box.remove();
  const box = make(
    "div",
    { class: "notice", "data-text": text },
    make("span", {}, text),
    action && make("button", { type: "button", onclick: () => (close(), action.run()) }, action.text),
    make("button", { type: "button", "aria-label": say("notice.close"), onclick: close }, "✕"),
  );
  shown.append(box);
  while (shown.children.length > MOST) shown.firstElementChild.remove();
  setTimeout(close, action ? 2 * STAYS_MS : STAYS_MS);
}

/** Tell screen readers. */
export function announce(text) {
  const said = the("said");
  if (said.textContent !== text) said.textContent = text;
}

/** Show why a request was refused, if it was. Returns whether it was accepted. */
export function accepted(reply) {
  if (!reply.ok) notice(reply.lost ? say("link.unanswered") : reply.text || say("refused"));
  return reply.ok;
}
