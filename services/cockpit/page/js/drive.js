// Driving by hand: taking the robot and giving it back, and the controls for it.
import { Gamepad, Stick, holdButton, useKeys } from "./controls.js";
import { make, mark, the, write } from "./dom.js";
import { Hold } from "./hold.js";
import { kept, keep } from "./kept.js";
import { accepted, announce, notice } from "./said.js";
import { stop } from "./stop.js";
import { title } from "./tasks.js";
import { number, say } from "./words.js";

const PACES = { gentle: 0.35, normal: 0.65, full: 1.0 };
const PARTS = {
  head: (x, y) => ({ pan_radps: -x, tilt_radps: y }),
  hand: (x, y) => ({ round_radps: -x, out_mps: y }),
};
const BUTTONS = [
  ["up", { up_mps: 1 }], ["down", { up_mps: -1 }], ["roll_left", { roll_radps: 1 }], ["roll_right", { roll_radps: -1 }],
  ["open", { grip: "open" }], ["close", { grip: "close" }],
]; // prettier-ignore
const ENDS_AFTER_MS = 1500;

export class Drive {
  /** `onMode(driving)`: called when driving by hand begins or ends here. */
  constructor(link, tasks, onMode) {
    this.link = link;
    this.tasks = tasks;
    this.onMode = onMode;
    this.driving = false;
    this.begunMs = 0;
    this.part = kept("part") in PARTS ? kept("part") : "head";
    this.pace = kept("pace") in PACES ? kept("pace") : "normal";
    this.pads = false;
    this.why = "";
    this.hold = new Hold(link, (why) => this.#changed(why));
    new Stick(the("stick-base"), this.hold, (x, y) => ({ speed_mps: y, turn_radps: -x }));
    new Stick(the("stick-part"), this.hold, (x, y) => PARTS[this.part](x, y));
    useKeys(this.hold);
    new Gamepad(this.hold, stop, (any) => ((this.pads = any), this.render()));
    for (const id of ["take-over", "begin-drive"]) the(id).addEventListener("click", () => this.begin());
    the("hand-back").addEventListener("click", () => this.end());
    document.addEventListener("keydown", (event) => event.key === "Escape" && this.driving && the("menu").hidden && this.end());
    document.addEventListener("stopping", () => this.#leave("stop"));
    link.on("lost", () => this.#leave("lost"));
  }

  /** Take a message `hello`. */
  greet(hello) {
    this.hold.limit(hello.limits ?? {});
    this.mayDrive = hello.role === "operator";
    this.render();
  }

  /** Take a message `state`. */
  see(state) {
    this.state = state;
    this.hold.see(state.drive?.tick);
    if (this.driving && !state.drive && performance.now() - this.begunMs > ENDS_AFTER_MS) this.#leave("ended");
    this.#tell();
  }

  /** Take the robot. A task that runs ends only when the person says so. */
  async begin(instead = false) {
    const reply = await this.link.ask({ do: "begin-drive", instead });
    if (reply.ok) {
      this.driving = this.hold.allowed = true;
      this.begunMs = performance.now();
      this.why = "";
      this.wake = await navigator.wakeLock?.request("screen").catch(() => null);
      announce(say("drive.begun"));
      document.activeElement?.blur(); // Enter shall not press the button again
      this.onMode(true);
      this.render();
    } else if (!instead && this.tasks.running) {
      const text = say("drive.busy", { running: title(this.tasks.running) });
      notice(text, { text: say("drive.instead"), run: () => this.begin(true) });
    } else {
      accepted(reply);
    }
  }

  async end() {
    if (!this.driving) return;
    this.#leave("");
    accepted(await this.link.ask({ do: "end-drive" }));
  }

  render() {
    for (const id of ["take-over", "begin-drive"]) the(id).disabled = !this.mayDrive;
    the("drive-part").replaceChildren(...Object.keys(PARTS).map((name) => this.#choice("part", name)));
    the("drive-pace").replaceChildren(...Object.keys(PACES).map((name) => this.#choice("pace", name)));
    this.hold.pace = PACES[this.pace];
    const buttons = BUTTONS.map(([name, motion]) => {
      const button = make("button", { type: "button", "aria-label": say(`drive.hold.${name}`) }, say(`drive.short.${name}`));
      holdButton(button, this.hold, motion);
      return button;
    });
    the("drive-holds").replaceChildren(...buttons);
    the("stick-part").setAttribute("aria-label", say(`drive.stick.${this.part}`));
    write(the("stick-part").querySelector("span"), say(`drive.part.${this.part}`));
    write(the("drive-keys"), say(this.pads ? "drive.keys_pad" : "drive.keys"));
    this.#tell();
  }

  #choice(kind, name) {
    const choose = () => {
      this[kind] = name;
      keep(kind, name);
      this.hold.letGo("chosen");
      this.render();
      the(`drive-${kind}`).querySelector('[aria-pressed="true"]').focus();
    };
    return make("button", { type: "button", "aria-pressed": String(this[kind] === name), onclick: choose }, say(`drive.${kind}.${name}`));
  }

  #leave(why) {
    if (!this.driving) return;
    this.driving = this.hold.allowed = false;
    this.hold.letGo(why || "ended");
    this.why = "";
    this.wake?.release().catch(() => {});
    if (why === "ended") notice(this.state?.task?.reason || say("drive.ended"));
    announce(say("drive.ended"));
    this.onMode(false);
    this.#tell();
  }

  #changed(why) {
    this.why = ["hidden", "left", "lost", "frozen", "gamepad", "keys"].includes(why) ? why : "";
    this.#tell();
  }

  #tell() {
    const shown = the("drive-state");
    let [text, kind] = [say("drive.off"), "off"];
    if (this.driving && this.hold.late) [text, kind] = [this.hold.refusal || say("drive.late"), "bad"];
    else if (this.driving && this.hold.moves) [text, kind] = [this.#speed(), "moves"];
    else if (this.driving) [text, kind] = [this.why ? say(`drive.let_go.${this.why}`) : say("drive.ready"), this.why ? "bad" : "ready"];
    else if (!this.mayDrive) text = say("do.viewer");
    write(shown, text);
    mark(shown, "data-state", kind);
  }

  #speed() {
    const speed = this.state?.base?.speed_mps ?? 0;
    return say("drive.moves", { speed: number(Math.abs(speed), 2) });
  }
}
