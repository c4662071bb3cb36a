// What the robot does now and why, in one line each.
import { make, mark, the, write } from "./dom.js";
import { announce } from "./said.js";
import { title } from "./tasks.js";
import { held } from "./objects.js";
import { called, metres, say, span } from "./words.js";

let told = "";

/** Show the task and the planner's reason of a message `state`. `mayCancel`: whether this person may end the task. */
export function showNow(state, mayCancel) {
  const { task, plan } = state;
  const runs = Boolean(task?.task_id && !task.outcome);
  the("cancel").hidden = !(runs && mayCancel);
  write(the("now-task"), task?.task_id ? outcome(task) : say("now.idle"));
  const phase = runs ? [called("phase", task.phase), task.distance_m != null ? metres(task.distance_m) : "", span(task.elapsed_s ?? 0)] : [];
  steps(the("now-phases"), runs ? (task.phases ?? []).length : 0, phase.filter(Boolean).join(" · "));
  const invites = !task?.task_id && mayCancel && state.latch !== "latched";
  const rest = () => sentence(task?.reason) || holds(state) || (invites ? say("now.invites") : plan?.why);
  write(the("now-why"), (runs ? plan?.why || task.text : rest()) || say("now.stands"));
  mark(the("now-task"), "class", runs ? null : { done: "good", failed: "bad", stopped: "warn" }[ending(task)]);
  const news = task?.task_id ? `${title(task)}: ${runs ? called("phase", task.phase) : say(`outcome.${ending(task)}`)}` : "";
  if (news && news !== told) announce(news);
  told = news;
}

function outcome(task) {
  return task.outcome ? `${title(task)} — ${say(`outcome.${ending(task)}`)}` : title(task);
}

/** How a task ended; one that failed because of the emergency stop was stopped. */
function ending(task) {
  return task?.reason?.startsWith("estop") ? "stopped" : task?.outcome;
}

/** What is in the hand, as a sentence; "" for nothing. */
function holds(state) {
  const label = held(state);
  return label === null ? "" : label ? say("now.holds", { object: called("object", label) }) : say("now.holds_something");
}

/** A reason without the word for programs before it. */
function sentence(reason) {
  return (reason ?? "").replace(/^\w+: /, "");
}

/** One dot for each phase so far, then the present one in words. */
function steps(box, count, text) {
  const shown = Math.min(count, 9);
  if (box.querySelectorAll("i").length !== shown || !box.lastChild || box.lastChild.nodeName === "I") {
    box.replaceChildren(...Array.from({ length: shown }, () => make("i", { "aria-hidden": "true" })), make("span"));
  }
  write(box.querySelector("span"), text);
}
