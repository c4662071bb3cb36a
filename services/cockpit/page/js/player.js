// Playing a capture: the same screen shows it, with a line of its time under the picture.
import { make, mark, the, write } from "./dom.js";
import { describe } from "./captures.js";
import { Link } from "./link.js";
import { notice } from "./said.js";
import { number, say } from "./words.js";

const SPEEDS = [1, 2, 4, 0.5];
const PAUSE = "M7 5v14M17 5v14";
const GO = "M8 5v14l11-7z";

export class Player {
  /** `onPlay(link, what)`: the screen shall show that link; null: the robot again. */
  constructor(onPlay) {
    this.onPlay = onPlay;
    this.link = null;
    this.played = { at_s: 0, duration_s: 0, paused: false, speed: 1, marks: [] };
    this.seeking = false;
    const line = the("play-at");
    line.addEventListener("input", () => this.#seek(Number(line.value)));
    line.addEventListener("change", () => (this.seeking = false));
    line.addEventListener("keydown", (event) => this.#key(event));
    the("play-pause").addEventListener("click", () => this.link?.send({ do: "pause", on: !this.played.paused }));
    the("play-speed").addEventListener("click", () => {
      const next = SPEEDS[(SPEEDS.indexOf(this.played.speed) + 1) % SPEEDS.length];
      this.link?.send({ do: "speed", x: next });
    });
    the("play-end").addEventListener("click", () => this.close());
  }

  open(capture) {
    this.close();
    this.what = describe(capture);
    const link = new Link(`/play?capture=${encodeURIComponent(capture.name)}`, { returns: false });
    this.link = link;
    link.on("played", (message) => this.#take(message));
    link.on("lost", ({ reason }) => {
      if (this.link !== link) return;
      notice(reason || say("play.lost"));
      this.close();
    });
    the("timeline").hidden = false;
    this.onPlay(link, this.what);
    the("play-pause").focus();
  }

  close() {
    if (this.link === null) return;
    const link = this.link;
    this.link = null;
    link.close();
    the("timeline").hidden = true;
    this.onPlay(null, "");
  }

  render() {
    const { at_s: at, duration_s: duration, paused, speed, marks } = this.played;
    const line = the("play-at");
    line.max = String(duration);
    if (!this.seeking) line.value = String(at);
    const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
    write(the("play-time"), `${clock(at)} / ${clock(duration)}`);
    line.setAttribute("aria-valuetext", `${clock(at)} / ${clock(duration)}${this.#phase(at, marks)}`);
    write(the("play-speed"), `${number(speed, speed < 1 ? 1 : 0)}×`);
    the("play-speed").setAttribute("aria-label", say("play.speed", { speed: number(speed, 1) }));
    const button = the("play-pause");
    const label = say(paused ? "play.go" : "play.pause");
    if (button.getAttribute("aria-label") !== label) {
      button.setAttribute("aria-label", label);
      button.innerHTML = "";
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      svg.setAttribute("viewBox", "0 0 24 24");
      svg.setAttribute("aria-hidden", "true");
      const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
      path.setAttribute("d", paused ? GO : PAUSE);
      svg.append(path);
      button.append(svg);
    }
    this.#marks(marks ?? [], duration);
  }

  #take(message) {
    this.played = { ...this.played, ...message };
    this.render();
  }

  #phase(at, marks) {
    const last = (marks ?? []).filter((one) => one.at_s <= at).at(-1);
    return last ? `, ${last.text}` : "";
  }

  #marks(marks, duration) {
    const box = the("play-marks");
    const seen = JSON.stringify([marks, duration]);
    if (box.dataset.seen === seen || !duration) return;
    box.dataset.seen = seen;
    box.replaceChildren(
      ...marks.map((one) => {
        const tick = make("i", { "data-kind": one.kind, title: one.text });
        tick.style.left = `${(100 * one.at_s) / duration}%`;
        return tick;
      }),
    );
  }

  #seek(at) {
    this.seeking = true;
    this.link?.send({ do: "seek", at_s: at });
  }

  /** Arrows go by a second; page up and down by the marks. */
  #key(event) {
    const { at_s: at, marks, duration_s: duration } = this.played;
    const times = (marks ?? []).map((one) => one.at_s);
    const goals = {
      ArrowRight: at + 1,
      ArrowLeft: at - 1,
      PageUp: times.find((time) => time > at + 0.2) ?? duration,
      PageDown: times.filter((time) => time < at - 0.5).at(-1) ?? 0,
    };
    if (!(event.key in goals)) return;
    event.preventDefault();
    this.link?.send({ do: "seek", at_s: Math.min(duration, Math.max(0, goals[event.key])) });
    mark(event.target, "data-at", goals[event.key].toFixed(1));
  }
}
