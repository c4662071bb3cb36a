// What is held by the hand, and nothing else: while something is held, the motion goes to the robot 25 times a second.
//
// Each message quotes the executive's newest tick, which counts for 0.2 s. So a message that waited somewhere moves nothing,
// and a held control needs an answer all the time. This side lets go by itself when the page is hidden, loses the focus or
// the connection, or was frozen; it sends nothing while nothing is held.
const PERIOD_MS = 40;
const FROZEN_MS = 200;
const UNCOUNTED_MS = 400;
const MOST_WAITING_BYTES = 1024;
const STATE_TICK_MS = 300;
/** The most that a control asks for; a robot that can do less says so. */
const MOST = {
  speed_mps: 0.5, turn_radps: 1.6, pan_radps: 1.0, tilt_radps: 0.8, out_mps: 0.08, round_radps: 0.5, up_mps: 0.08, roll_radps: 0.8,
}; // prettier-ignore

export class Hold {
  /** `link`: a `Link`; `onChange(why)`: called when it begins or ends, or `late` changes. */
  constructor(link, onChange) {
    this.link = link;
    this.onChange = onChange;
    this.held = new Map();
    this.limits = { ...MOST };
    this.pace = 0.6;
    this.tick = 0;
    this.tickMs = -STATE_TICK_MS;
    this.countedMs = 0;
    this.refusal = "";
    this.beganMs = 0;
    this.beatMs = 0;
    this.timer = 0;
    this.late = false;
    this.allowed = false;
    link.on("tick", (message) => this.take(message));
    link.on("lost", () => this.letGo("lost"));
    document.addEventListener("visibilitychange", () => document.hidden && this.letGo("hidden"));
    document.addEventListener("freeze", () => this.letGo("hidden"));
    for (const kind of ["blur", "pagehide"]) window.addEventListener(kind, () => this.letGo("left"));
    document.addEventListener("stopping", () => this.letGo("stop"));
  }

  /** Take what the robot says it can do at most, by the names of a motion. */
  limit(limits) {
    for (const name of Object.keys(MOST)) this.limits[name] = Math.min(MOST[name], limits[name] ?? MOST[name]);
  }

  /** The answer to a motion: the next tick, and whether the motion counted. */
  take({ tick, accepted = true, text = "" }) {
    this.tick = tick;
    this.tickMs = performance.now();
    if (accepted) this.countedMs = this.tickMs;
    this.refusal = accepted ? "" : text;
  }

  /** A tick in a message `state`, which may be older than one that came as an answer. */
  see(tick) {
    if (performance.now() - this.tickMs > STATE_TICK_MS && tick != null) this.tick = tick;
  }

  get moves() {
    return this.held.size > 0;
  }

  /** `source` holds these fields of a motion: shares of the limits from -1 to 1, or `grip`. An empty one lets go. */
  hold(source, motion) {
    if (!this.allowed || document.hidden || !document.hasFocus()) return;
    const moved = this.moves;
    if (Object.values(motion).some((value) => value)) this.held.set(source, motion);
    else this.held.delete(source);
    if (this.moves && !moved) this.#begin();
    if (!this.moves && moved) this.#end("released");
  }

  /** `source` holds nothing any more. */
  release(source) {
    if (this.held.delete(source) && !this.moves) this.#end("released");
  }

  /** Nothing is held any more, whatever the fingers do: each control must be held anew. */
  letGo(why) {
    const moved = this.moves;
    this.held.clear();
    document.dispatchEvent(new CustomEvent("let-go"));
    if (moved) this.#end(why);
  }

  /** The motion of all sources together: fields of `Motion`, m/s and rad/s. */
  motion() {
    const sum = {};
    let grip = "";
    for (const part of this.held.values()) {
      for (const [name, share] of Object.entries(part)) {
        if (name === "grip") grip = share;
        else sum[name] = Math.max(-1, Math.min(1, (sum[name] ?? 0) + share));
      }
    }
    const motion = Object.fromEntries(Object.entries(sum).map(([name, share]) => [name, share * this.limits[name] * this.pace]));
    return grip ? { ...motion, grip } : motion;
  }

  #begin() {
    this.beganMs = this.beatMs = performance.now();
    this.late = false;
    this.timer = setInterval(() => this.#beat(), PERIOD_MS);
    this.#beat();
    this.onChange("held");
  }

  #end(why) {
    clearInterval(this.timer);
    this.timer = 0;
    this.late = false;
    this.link.send({ do: "drive", tick: this.tick, motion: {} }); // brakes now, rather than when the last motion expires
    this.onChange(why);
  }

  #beat() {
    const nowMs = performance.now();
    const frozen = nowMs - this.beatMs > FROZEN_MS;
    this.beatMs = nowMs;
    if (frozen) this.letGo("frozen");
    else if (document.hidden || !document.hasFocus()) this.letGo("left");
    else if (!this.link.isOpen) this.letGo("lost");
    if (!this.moves) return;
    if (this.link.waitingBytes < MOST_WAITING_BYTES) this.link.send({ do: "drive", tick: this.tick, motion: this.motion() });
    const late = nowMs - Math.max(this.countedMs, this.beganMs) > UNCOUNTED_MS;
    if (late !== this.late) {
      this.late = late;
      this.onChange("late");
    }
  }
}
