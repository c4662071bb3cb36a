// The menu of what can be done with "this" and "there", beside the place that was pointed at.
import { make, the } from "./dom.js";
import { accepted } from "./said.js";
import { called, metres, say } from "./words.js";

export class Menu {
  /** `link`: where the question goes; `tasks`: the `Tasks` to choose from. */
  constructor(link, tasks) {
    this.link = link;
    this.tasks = tasks;
    this.box = the("menu");
    this.back = null;
    document.addEventListener("pointerdown", (event) => this.box.contains(event.target) || this.close());
    this.box.addEventListener("keydown", (event) => this.#key(event));
  }

  /** Ask what is there, and show what can be done with it. `question`: {picture} or {map}; x, y within `section`. */
  async ask(question, stamp, section, x, y) {
    this.close();
    const back = document.activeElement;
    const reply = await this.link.ask({ do: "what", ...question }, stamp);
    if (accepted(reply)) this.#show(reply.data ?? {}, section, x, y, back);
  }

  close() {
    if (this.box.hidden) return;
    const inside = this.box.contains(document.activeElement);
    this.box.hidden = true;
    if (inside) this.back?.focus();
  }

  #show(found, section, x, y, back) {
    const items = [];
    if (found.label) {
      for (const task of this.tasks.with(found.label)) items.push(this.#item(task, { label: found.label }));
    }
    if (found.place && !found.label) {
      const [x_m, y_m] = found.place;
      for (const task of this.tasks.atPlaces) items.push(this.#item(task, { x_m, y_m }));
    }
    const name = found.label ? called("object", found.label) : say(found.place ? "menu.there" : "menu.nothing");
    const body = this.tasks.state.plan?.body;
    const away = found.place && body ? say("menu.away", { away: metres(Math.hypot(found.place[0] - body[0], found.place[1] - body[1])) }) : "";
    this.box.replaceChildren(make("p", {}, name), away ? make("p", {}, away) : "", ...items);
    this.box.setAttribute("aria-label", name);
    section.append(this.box);
    this.box.hidden = false;
    const { clientWidth: width, clientHeight: height } = section;
    this.box.style.left = `${Math.max(4, Math.min(x + 6, width - this.box.offsetWidth - 4))}px`;
    this.box.style.top = `${Math.max(4, Math.min(y + 6, height - this.box.offsetHeight - 4))}px`;
    this.back = back;
    this.box.tabIndex = -1;
    (items[0] ?? this.box).focus();
  }

  #item(task, at) {
    const run = () => {
      this.close();
      this.tasks.run({ task: task.name, ...at });
    };
    return make("button", { type: "button", onclick: run }, called("task", task.name));
  }

  #key(event) {
    const items = [...this.box.querySelectorAll("button")];
    const at = items.indexOf(document.activeElement);
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (step && items.length) {
      event.preventDefault();
      items[(at + step + items.length) % items.length].focus();
    } else if (event.key === "Escape" || event.key === "Tab") {
      event.preventDefault();
      this.close();
    }
  }
}
