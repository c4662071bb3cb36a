// Objects and tasks to choose from, built from what the server says there is: a task of a third party appears, too.
import { make, mark, the, write } from "./dom.js";
import { held, swatch } from "./objects.js";
import { accepted, announce, notice } from "./said.js";
import { called, metres, say, span } from "./words.js";

const FIRST = ["fetch", "follow", "go-to", "touch", "put-down", "park"];
const OWN_BUTTON = ["drive"];
const MAIN = "fetch";
const PLACE = ["x_m", "y_m"];
const SEEN_S = 1.5;
const UPDATE_MS = 400;

export class Tasks {
  /** `link`: where requests go. */
  constructor(link) {
    this.link = link;
    this.tasks = [];
    this.objects = [];
    this.chosen = null;
    this.more = false;
    this.state = {};
    this.inView = [];
    this.toldMs = 0;
  }

  /** Take a message `hello`. */
  greet(hello) {
    this.tasks = hello.tasks ?? [];
    this.objects = hello.objects ?? [];
    this.mayOperate = hello.role === "operator";
    if (!this.objects.some((item) => item.label === this.chosen)) {
      this.chosen = (this.objects.find((item) => item.graspable) ?? this.objects[0])?.label ?? null;
    }
    this.render();
  }

  /** Take a message `state` and the labels in the picture. */
  see(state, inView) {
    this.state = state;
    this.inView = inView;
    if (performance.now() - this.toldMs < UPDATE_MS) return;
    this.toldMs = performance.now();
    for (const button of the("objects").children) write(button.querySelector("small"), this.#where(button.dataset.label));
  }

  /** The task that runs now; null without one. */
  get running() {
    const task = this.state.task;
    return task && task.task_id && !task.outcome ? task : null;
  }

  /** Tasks that can be done with that object. */
  with(label) {
    const item = this.objects.find((known) => known.label === label);
    return this.#listed().filter((task) => task.label === "known" || (task.label === "graspable" && item?.graspable));
  }

  /** Tasks that are done at a place. */
  get atPlaces() {
    return this.tasks.filter((task) => !task.label && placeOf(task).length === PLACE.length);
  }

  /** Ask for a task. A robot that is busy is taken from its task only when the person says so. */
  async run(task, instead = false) {
    const reply = await this.link.ask({ do: "run", task, instead });
    if (reply.ok) {
      announce(say("task.begun", { task: title(task) }));
    } else if (!instead && this.running) {
      const text = say("task.busy", { running: title(this.running), task: title(task) });
      notice(text, { text: say("task.instead"), run: () => this.run(task, true) });
    } else {
      accepted(reply);
    }
  }

  async cancel() {
    accepted(await this.link.ask({ do: "cancel" }));
  }

  render() {
    the("do").querySelectorAll("h2, .objects, .tasks, #take-over").forEach((part) => (part.hidden = !this.mayOperate));
    the("viewer").hidden = this.mayOperate !== false;
    const objects = this.objects.filter((item) => this.more || item.graspable || item.label === this.chosen);
    the("objects").replaceChildren(...objects.map((item) => this.#object(item)));
    const all = this.#listed().filter((task) => !task.label || this.with(this.chosen).includes(task));
    const shown = all.filter((task) => this.more || FIRST.includes(task.name));
    const parts = shown.map((task) => this.#button(task));
    parts.push(the("take-over"));
    if (shown.length < all.length || objects.length < this.objects.length || this.more) parts.push(this.#moreButton());
    the("tasks").replaceChildren(...parts);
    the("options").hidden = true;
  }

  #listed() {
    const rank = (task) => (FIRST.includes(task.name) ? FIRST.indexOf(task.name) : FIRST.length);
    const order = (one, other) => rank(one) - rank(other);
    return this.tasks.filter((task) => !OWN_BUTTON.includes(task.name) && !needsPlace(task)).sort(order);
  }

  #object(item) {
    return make(
      "button",
      {
        type: "button",
        class: "object",
        "data-label": item.label,
        "aria-pressed": String(item.label === this.chosen),
        onclick: () => {
          this.chosen = item.label;
          this.render();
          the("objects").querySelector(`[data-label="${CSS.escape(item.label)}"]`)?.focus();
        },
      },
      swatch(item),
      make("span", {}, make("b", {}, called("object", item.label)), make("small", {}, this.#where(item.label))),
    );
  }

  #where(label) {
    const plan = this.state.plan;
    if (held(this.state) === label) return say("where.held");
    const seen = (plan?.known ?? []).find((item) => item.label === label);
    if (!seen) return say(this.inView.includes(label) ? "where.in_view" : "where.never");
    const away = plan.body ? metres(Math.hypot(seen.x - plan.body[0], seen.y - plan.body[1])) : "";
    const when = seen.age_s < SEEN_S ? say("where.in_view") : say("where.ago", { span: span(seen.age_s) });
    return [away, when].filter(Boolean).join(", ");
  }

  #button(task) {
    const options = task.options.filter((option) => !PLACE.includes(option.name));
    const open = () => this.#open(task, options);
    const run = () => this.run({ task: task.name, ...(task.label ? { label: this.chosen } : {}) });
    const begin = options.some((option) => option.needed) ? open : run;
    const main = task.name === MAIN && task.label;
    const name = make("span", {}, main ? title({ task: task.name, label: this.chosen }) : called("task", task.name));
    const button = make("button", { type: "button", class: `task${main ? " first" : ""}`, onclick: begin }, name);
    if (options.length === 0) return button;
    const label = say("task.options", { task: called("task", task.name) });
    return make("div", { class: "pair" }, button, make("button", { type: "button", class: `task${main ? " first" : ""}`, "aria-label": label, onclick: open }, "⋯"));
  }

  #moreButton() {
    const turn = () => {
      this.more = !this.more;
      this.render();
      the("tasks").querySelector(".more").focus();
    };
    const text = say(this.more ? "task.fewer" : "task.more");
    return make("button", { type: "button", class: "task more", "aria-expanded": String(this.more), onclick: turn }, text);
  }

  #open(task, options) {
    const form = the("options");
    const fields = options.map((option) => [option, field(option)]);
    const object = task.label ? ` ${called("object", this.chosen)}` : "";
    const begin = (event) => {
      event.preventDefault();
      const values = Object.fromEntries(fields.map(([option, input]) => [option.name, valueOf(option, input)]));
      for (const name of Object.keys(values)) if (values[name] === undefined) delete values[name];
      form.hidden = true;
      this.run({ task: task.name, ...(task.label ? { label: this.chosen } : {}), ...values });
    };
    form.onsubmit = begin;
    form.replaceChildren(
      make("h3", {}, called("task", task.name) + object),
      make("p", { class: "soft" }, task.doc ?? ""),
      ...fields.map(([option, input]) => make("label", {}, option.description || called("option", option.name), input)),
      make(
        "div",
        { class: "row" },
        make("button", { type: "button", class: "plain", onclick: () => (form.hidden = true) }, say("close")),
        make("button", { type: "submit", class: "plain strong" }, say("task.begin")),
      ),
    );
    form.hidden = false;
    form.scrollIntoView({ block: "nearest" });
    form.querySelector("input, button")?.focus();
    mark(form, "aria-label", called("task", task.name));
  }
}

/** What a running or asked-for task is called: `Fetch red can`. */
export function title(task) {
  return [called("task", task.task), task.label ? called("object", task.label) : ""].filter(Boolean).join(" ");
}

function placeOf(task) {
  return (task.options ?? []).filter((option) => PLACE.includes(option.name));
}

function needsPlace(task) {
  return placeOf(task).some((option) => option.needed);
}

function isTruth(option) {
  return option.type === "bool" || typeof option.default === "boolean";
}

function field(option) {
  if (isTruth(option)) {
    const box = make("input", { type: "checkbox" });
    box.checked = option.default === true;
    box.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return; // space stops the robot: Enter sets the box
      event.preventDefault();
      box.checked = !box.checked;
    });
    return box;
  }
  const isText = option.type === "str" || typeof option.default === "string";
  return make("input", {
    type: isText ? "text" : "number",
    value: option.default ?? null,
    min: option.min ?? null,
    max: option.max ?? null,
    step: isText ? null : option.type === "int" ? "1" : "any",
    required: Boolean(option.needed),
  });
}

function valueOf(option, input) {
  if (isTruth(option)) return input.checked;
  if (input.value.trim() === "") return undefined;
  return input.type === "number" ? Number(input.value) : input.value;
}
