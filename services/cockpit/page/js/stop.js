// STOP: the button, and the space bar everywhere. It needs no other module to work, and no connection that stands.
//
// It goes by the open socket and by an HTTP request of its own at once, and again until somebody acknowledges it.
const AGAIN_MS = 400;
const TRIES = 50;
const ALARM_MS = 1500;
const CLICK_MS = 700;

const button = document.getElementById("stop");
const state = document.getElementById("stop-state");
let send = () => false;
let words = (name, values) => (values?.services ? `${name}: ${values.services}` : name);
let since = 0;
let timer = 0;
let tries = 0;
let pressedMs = -CLICK_MS;

/** Let STOP use an open socket, too: `bySocket()` sends it, and `say` has the texts. */
export function connect(bySocket, say) {
  send = bySocket;
  words = say;
}

/** Stop the robot now. */
export function stop() {
  since = performance.now();
  tries = 0;
  clearInterval(timer);
  timer = setInterval(again, AGAIN_MS);
  again();
  show("sent", words("stop.sent"));
  document.dispatchEvent(new CustomEvent("stopping"));
  navigator.vibrate?.(60);
}

/** Take what the server tells of a stop, here or by anybody else. */
export function stopped(answer) {
  const done = answer.acknowledged ?? [];
  const missing = answer.missing ?? [];
  if (done.length === 0 && missing.length > 0) {
    show("bad", words("stop.nobody"));
    return;
  }
  if (done.length === 0) return;
  clearInterval(timer);
  const values = { services: done.join(", "), ms: Math.max(1, Math.round(answer.ms ?? performance.now() - since)) };
  if (missing.length > 0) show("bad", words("stop.partly", { ...values, missing: missing.join(", ") }));
  else show("good", words("stop.done", values));
}

/** Show what the latch tells where nobody pressed STOP here: latched, or released again. */
export function latch(isLatched) {
  if (!isLatched) show("", "");
  else if (!button.dataset.state) show("good", words("stop.latched"));
}

function again() {
  tries += 1;
  if (tries > TRIES) clearInterval(timer);
  try {
    send();
  } catch (error) {
    console.warn("the socket does not take STOP", error);
  }
  fetch("/stop", { method: "POST", keepalive: true, credentials: "same-origin", headers: { "X-Cockpit": "1" } })
    .then((answer) => answer.json())
    .then((answer) => answer && stopped(answer))
    .catch(() => {});
  if (performance.now() - since > ALARM_MS) show("bad", words("stop.nobody"));
}

function show(name, text) {
  button.dataset.state = name;
  state.dataset.state = name;
  if (state.textContent !== text) state.textContent = text;
}

button.addEventListener("pointerdown", (event) => {
  if (event.button > 0) return;
  pressedMs = performance.now();
  stop();
});
button.addEventListener("click", () => performance.now() - pressedMs > CLICK_MS && stop()); // by Enter, or a screen reader

// In the capture phase and before every other listener: space stops, and does nothing else, wherever the focus is.
for (const kind of ["keydown", "keyup", "keypress"]) {
  window.addEventListener(
    kind,
    (event) => {
      if (event.code !== "Space" && event.key !== " ") return;
      event.preventDefault();
      event.stopImmediatePropagation();
      if (kind === "keydown" && !event.repeat) stop();
    },
    { capture: true },
  );
}
