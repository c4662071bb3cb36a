// The list of captures: watch, download, keep, delete.
import { drawing, make, the } from "./dom.js";
import { notice } from "./said.js";
import { called, bytes, moment, say, span } from "./words.js";

const OLD_DAYS = 30;
const LINES = {
  watch: ["M8 5v14l11-7z"],
  download: ["M12 4v11M7 11l5 5 5-5M5 20h14"],
  pin: ["M9 4h6l-1 6 3 3H7l3-3zM12 13v7"],
  remove: ["M5 7h14M10 7V4h4v3M7 7l1 13h8l1-13"],
};

export class Captures {
  /** `onWatch(capture)`: play that one. */
  constructor(onWatch) {
    this.onWatch = onWatch;
    this.mayChange = false;
    this.captures = null;
  }

  /** Ask for the list, and show it. */
  async open() {
    this.render();
    try {
      const answer = await request("GET", "/captures");
      this.captures = Array.isArray(answer) ? answer : answer.captures;
    } catch (error) {
      notice(error.message);
    }
    this.render();
  }

  render() {
    const panel = the("captures");
    const head = panel.querySelector("header");
    const list = (this.captures ?? []).filter((capture) => !capture.gone);
    const items = list.map((capture) => this.#item(capture));
    const none = this.captures === null ? say("captures.loading") : say("captures.none");
    const parts = [items.length ? make("ul", { class: "shelf" }, ...items) : make("p", { class: "soft" }, none)];
    if (items.length && this.mayChange) parts.push(this.#cleaning());
    panel.replaceChildren(...(head ? [head] : []), ...parts);
  }

  #item(capture) {
    const what = describe(capture);
    const facts = [
      capture.began_ns ? moment(capture.began_ns / 1e9) : "",
      capture.duration_s ? span(capture.duration_s) : "",
      bytes(capture.size_bytes ?? 0),
      capture.written ? say("captures.written") : capture.closed === false ? say("captures.open") : "",
    ];
    const how = capture.outcome ? { done: "good", failed: "bad" }[capture.outcome] ?? "warn" : null;
    const outcome = capture.outcome ? make("span", { class: how }, ` — ${say(`outcome.${capture.outcome}`)}`) : "";
    const path = `/captures/${encodeURIComponent(capture.name)}`;
    const doing = [
      this.#button("watch", what, () => this.onWatch(capture)),
      make("a", { class: "round", href: `${path}/file`, download: true, "aria-label": say("captures.download", { what }) }, drawing(...LINES.download)),
    ];
    if (this.mayChange) {
      const pin = this.#button("pin", what, () => this.#change("POST", `${path}/${capture.pinned ? "unpin" : "pin"}`));
      pin.setAttribute("aria-pressed", String(Boolean(capture.pinned)));
      doing.push(pin);
      if (!capture.pinned && !capture.written) doing.push(this.#button("remove", what, (event) => this.#sure(event.currentTarget, path, what)));
    }
    return make("li", {}, make("span", { class: "what" }, what, outcome), make("span", { class: "facts" }, facts.filter(Boolean).join(" · ")), make("span", { class: "doing" }, ...doing));
  }

  #button(name, what, run) {
    return make("button", { type: "button", class: "round", "aria-label": say(`captures.${name}`, { what }), onclick: run }, drawing(...LINES[name]));
  }

  #sure(button, path, what) {
    const sure = make("button", { type: "button", class: "plain danger", onclick: () => this.#change("DELETE", path), onblur: () => sure.replaceWith(button) }, say("captures.sure"));
    sure.setAttribute("aria-label", `${say("captures.sure")} ${what}`);
    button.replaceWith(sure);
    sure.focus();
  }

  #cleaning() {
    const clean = (rule, words) => {
      const button = make("button", { type: "button", class: "plain" }, words);
      button.addEventListener("click", () => {
        if (button.dataset.sure) this.#change("POST", "/captures/clean", rule);
        else {
          button.dataset.sure = "1";
          button.classList.add("danger");
          button.textContent = `${words}: ${say("captures.sure")}`;
        }
      });
      return button;
    };
    return make("p", { class: "cleaning" }, clean({ older_than_days: OLD_DAYS }, say("captures.clean_old", { days: OLD_DAYS })), clean({ idle: true }, say("captures.clean_idle")));
  }

  async #change(method, path, body) {
    try {
      const answer = await request(method, path, body);
      if (answer?.deleted) notice(say("captures.deleted", { count: answer.deleted.length }));
    } catch (error) {
      notice(error.message);
    }
    await this.open();
  }
}

/** What a capture shows, in words. */
export function describe(capture) {
  const [task, ...rest] = (capture.what || "").split(" ");
  return task ? [called("task", task), ...rest.map((word) => called("object", word))].join(" ") : say("captures.idle");
}

async function request(method, path, body) {
  const headers = { "X-Cockpit": "1", ...(body ? { "Content-Type": "application/json" } : {}) };
  const answer = await fetch(path, { method, headers, body: body ? JSON.stringify(body) : undefined, credentials: "same-origin" });
  if (!answer.ok) throw new Error((await answer.text()).trim() || `${answer.status} ${answer.statusText}`);
  return answer.json();
}
