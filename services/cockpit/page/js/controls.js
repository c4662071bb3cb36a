// What a hand can hold: sticks and buttons on the screen, keys, a gamepad. Each tells a `Hold` what it holds.
import { mark } from "./dom.js";

const DEAD = 0.1;
const POLL_MS = 40;
const SHOULDERS = [4, 5];
const STOP_BUTTON = 1;
const GRIP_BUTTONS = { 0: "close", 3: "open" };

/** A share without the dead zone in the middle, and gentler near it. */
function shaped(value) {
  const size = Math.max(0, (Math.abs(value) - DEAD) / (1 - DEAD));
  return Math.sign(value) * size * (0.4 + 0.6 * size);
}

/** A stick on the screen. `motionOf(x, y)`: the motion of a deflection; right and up are positive, at most 1. */
export class Stick {
  constructor(element, hold, motionOf) {
    this.element = element;
    this.hold = hold;
    this.motionOf = motionOf;
    this.pointer = null;
    element.addEventListener("pointerdown", (event) => this.#down(event));
    element.addEventListener("pointermove", (event) => event.pointerId === this.pointer && this.#move(event));
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
      element.addEventListener(kind, (event) => event.pointerId === this.pointer && this.release());
    }
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    document.addEventListener("let-go", () => this.release());
  }

  release() {
    if (this.pointer === null) return;
    this.pointer = null;
    this.hold.release(this.element.id);
    this.#show(0, 0);
    mark(this.element, "data-held", null);
  }

  #down(event) {
    if (this.pointer !== null || event.button > 0 || !this.hold.allowed) return;
    event.preventDefault();
    this.element.setPointerCapture(event.pointerId);
    this.pointer = event.pointerId;
    mark(this.element, "data-held", true);
    this.#move(event);
  }

  #move(event) {
    const box = this.element.getBoundingClientRect();
    let x = (event.clientX - box.left - box.width / 2) / (box.width * 0.36);
    let y = -(event.clientY - box.top - box.height / 2) / (box.height * 0.36);
    const far = Math.hypot(x, y);
    if (far > 1) [x, y] = [x / far, y / far];
    this.#show(x, y);
    this.hold.hold(this.element.id, this.motionOf(shaped(x), shaped(y)));
  }

  #show(x, y) {
    this.element.style.setProperty("--x", x.toFixed(3));
    this.element.style.setProperty("--y", y.toFixed(3));
  }
}

/** Make a button that moves something for as long as it is pressed, with a pointer or with Enter. */
export function holdButton(button, hold, motion) {
  const source = `button ${JSON.stringify(motion)}`;
  let pointer = null;
  const press = (by) => {
    if (!hold.allowed) return;
    pointer = by;
    mark(button, "data-held", true);
    hold.hold(source, motion);
  };
  const release = () => {
    if (pointer === null) return;
    pointer = null;
    mark(button, "data-held", null);
    hold.release(source);
  };
  button.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    button.setPointerCapture(event.pointerId);
    press(event.pointerId);
  });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(kind, release);
  button.addEventListener("keydown", (event) => event.key === "Enter" && !event.repeat && press("key"));
  button.addEventListener("keyup", (event) => event.key === "Enter" && release());
  button.addEventListener("blur", release);
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  document.addEventListener("let-go", release);
}

/** Keys by their place on the keyboard. None of them is on another place of a German or an English one. */
export const KEYS = {
  KeyW: { speed_mps: 1 }, KeyS: { speed_mps: -1 }, KeyA: { turn_radps: 1 }, KeyD: { turn_radps: -1 },
  ArrowUp: { speed_mps: 1 }, ArrowDown: { speed_mps: -1 }, ArrowLeft: { turn_radps: 1 }, ArrowRight: { turn_radps: -1 },
  KeyI: { tilt_radps: 1 }, KeyK: { tilt_radps: -1 }, KeyJ: { pan_radps: 1 }, KeyL: { pan_radps: -1 },
  KeyT: { out_mps: 1 }, KeyG: { out_mps: -1 }, KeyF: { round_radps: 1 }, KeyH: { round_radps: -1 },
  KeyR: { up_mps: 1 }, KeyV: { up_mps: -1 }, KeyQ: { roll_radps: 1 }, KeyE: { roll_radps: -1 },
  KeyO: { grip: "open" }, KeyC: { grip: "close" },
}; // prettier-ignore

/** Let keys move the robot while they are held down. */
export function useKeys(hold) {
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) {
      hold.letGo("keys"); // the system may keep the release of keys to itself now
      return;
    }
    const motion = KEYS[event.code];
    if (!hold.allowed || !motion || event.target.matches?.("input")) return;
    event.preventDefault();
    if (!event.repeat) hold.hold(event.code, motion);
  });
  window.addEventListener("keyup", (event) => hold.release(event.code));
}

/** Let a gamepad move the robot while one of its shoulder buttons is held. Its second button (B, circle) stops. */
export class Gamepad {
  constructor(hold, stop, onPads) {
    this.hold = hold;
    this.stop = stop;
    this.mayHold = false;
    this.pressed = false;
    this.timer = 0;
    const look = () => {
      const any = this.#pads().length > 0;
      onPads(any);
      clearInterval(this.timer);
      this.timer = any ? setInterval(() => this.#poll(), POLL_MS) : 0;
      if (!any) hold.release("gamepad");
    };
    window.addEventListener("gamepadconnected", look);
    window.addEventListener("gamepaddisconnected", () => (hold.letGo("gamepad"), look()));
    document.addEventListener("let-go", () => (this.mayHold = false));
  }

  #pads() {
    return [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected);
  }

  #poll() {
    const pads = this.#pads();
    const down = (index) => pads.some((pad) => pad.buttons[index]?.pressed);
    if (down(STOP_BUTTON) && !this.pressed) this.stop();
    this.pressed = down(STOP_BUTTON);
    const pad = pads.find((one) => SHOULDERS.some((index) => one.buttons[index]?.pressed));
    if (!pad) {
      this.mayHold = true; // the shoulder was let go: it may begin anew
      this.hold.release("gamepad");
      return;
    }
    if (!this.mayHold) return;
    const [turn, ahead, pan, tilt] = pad.axes.map((axis) => shaped(axis) || 0);
    const grip = Object.entries(GRIP_BUTTONS).find(([index]) => pad.buttons[index]?.pressed)?.[1];
    const button = (index) => (pad.buttons[index]?.pressed ? 1 : 0);
    this.hold.hold("gamepad", {
      speed_mps: -ahead,
      turn_radps: -turn,
      pan_radps: -pan,
      tilt_radps: -tilt,
      up_mps: button(12) - button(13),
      round_radps: button(14) - button(15),
      out_mps: (pad.buttons[7]?.value ?? 0) - (pad.buttons[6]?.value ?? 0),
      ...(grip ? { grip } : {}),
    });
  }
}
