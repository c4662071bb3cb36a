// Puts the page together: one link to the robot, perhaps one to a capture, and the parts of the screen that show them.
import { Captures } from "./captures.js";
import { forgetColours, make, mark, the, write } from "./dom.js";
import { Drive } from "./drive.js";
import { showHealth } from "./health.js";
import { kept, keep } from "./kept.js";
import { Link } from "./link.js";
import { logChoice, takeLog } from "./log.js";
import { FloorMap } from "./map.js";
import { Menu } from "./menu.js";
import { showNow } from "./now.js";
import { Player } from "./player.js";
import { accepted, announce } from "./said.js";
import * as stopping from "./stop.js";
import { Tasks } from "./tasks.js";
import { View } from "./view.js";
import { LANGUAGES, bytes, preferred, say, speak } from "./words.js";

const PANELS = ["health", "captures", "log"];
const THEMES = ["auto", "light", "dark"];
const LOW_BATTERY = 0.25;
const EMPTY_BATTERY = 0.12;
const TOO_SOON_MS = 700;

const app = the("app");
document.documentElement.dataset.theme = kept("theme") ?? "auto";
await speak(preferred());

const live = new Link("/live");
const tasks = new Tasks(live);
const menu = new Menu(live, tasks);
let shown = live;
let hello = null;
let latch = "";
let releasableMs = 0;

const view = new View((u, v, x, y) => {
  if (shown !== live || !tasks.mayOperate) return;
  const { width, height, stamp } = view.header;
  menu.ask({ picture: { stamp_ns: "#stamp", u, v, width, height } }, stamp, view.canvas.parentElement, x, y);
});
const map = new FloorMap((x, y, left, top) => {
  if (shown === live && tasks.mayOperate) menu.ask({ map: [x, y] }, "", map.canvas.parentElement, left, top);
});
const captures = new Captures((capture) => player.open(capture));
const player = new Player((link, what) => show(link ?? live, what));
const drive = new Drive(live, tasks, (driving) => {
  mark(app, "data-driving", driving);
  view.drivingKeys = map.drivingKeys = driving;
  menu.close();
  if (driving) openPanel(null);
});

/** Let the screen show the robot or a capture. */
function show(link, what) {
  shown = link;
  const playing = link !== live;
  mark(app, "data-playing", playing);
  view.isPlay = playing;
  view.clear();
  map.clear();
  menu.close();
  if (playing) {
    drive.end();
    openPanel(null);
    feed(link);
  }
  live.send({ do: "pictures", on: !playing && !document.hidden });
  linkState(playing ? "play" : live.isOpen ? "live" : "lost", what);
}

/** Bring what a link tells into the parts that show it, while it is the one that is shown. */
function feed(link) {
  link.on("picture", async (header, blob) => {
    if (shown === link) await view.take(header, blob);
    link.sendWithStamp({ do: "seen", stamp_ns: "#stamp" }, header.stamp);
  });
  link.on("map", (plan) => shown === link && map.take(plan));
  link.on("state", (state) => {
    if (shown !== link) return;
    showNow(state, link === live && tasks.mayOperate);
    map.see(state.plan);
  });
}

function linkState(name, what = "") {
  const pill = the("link-state");
  mark(pill, "data-state", name);
  write(pill, name === "play" ? say("link.play", { what }) : say(`link.${name}`));
}

live.on("open", () => {
  live.send({ do: "pictures", on: shown === live && !document.hidden });
  live.send({ do: "log", on: !the("log").hidden });
});
live.on("hello", (message) => {
  hello = message;
  greet();
  if (shown === live) linkState("live");
});
live.on("lost", ({ code }) => {
  if (shown === live) linkState("lost");
  announce(say("link.lost"));
  if (code === 1008 || code === 4401 || code === 4403) location.reload(); // the server asks who this is
});
live.on("stopped", (message) => stopping.stopped(message));
live.on("log", takeLog);
live.on("state", (state) => {
  tasks.see(state, view.labels);
  drive.see(state);
  showHealth(state);
  battery(state.base);
  recording(state.recording);
  if (state.latch !== latch) {
    if (state.latch === "latched" || latch === "latched") stopping.latch(state.latch === "latched");
    latch = state.latch;
  }
  const mayRelease = latch === "latched" && tasks.mayOperate;
  if (mayRelease && the("release").hidden) releasableMs = performance.now();
  the("release").hidden = !mayRelease;
});
feed(live);
stopping.connect(() => live.send({ do: "stop", id: 0 }), say);

function greet() {
  if (hello === null) return;
  write(the("robot"), hello.robot);
  document.title = `${hello.robot} – CoCoRo`;
  map.bodyM = hello.body?.radius_m ?? map.bodyM;
  captures.mayChange = hello.role === "operator";
  tasks.greet(hello);
  drive.greet(hello);
}

function battery(base) {
  const shownAs = the("battery");
  shownAs.hidden = base?.battery == null;
  if (shownAs.hidden) return;
  const share = Math.round(base.battery * 100);
  mark(shownAs, "data-state", base.charging ? "good" : base.battery < EMPTY_BATTERY ? "bad" : base.battery < LOW_BATTERY ? "warn" : "good");
  write(shownAs, `${base.charging ? "⚡ " : ""}${share} %`);
  mark(shownAs, "aria-label", say(base.charging ? "battery.charges" : "battery", { share }));
  mark(shownAs, "role", "img");
}

function recording(state) {
  const button = the("open-captures");
  const bad = Boolean(state?.fault) || state?.dropped > 0;
  mark(button.querySelector(".dot"), "data-state", !state ? "" : bad ? "warn" : state.file ? "good" : "");
  const text = !state ? say("captures.title") : state.fault ? say("captures.fault") : bytes(state.size_bytes ?? 0);
  write(button.querySelector(".value"), text);
  mark(button, "aria-label", `${say("captures.title")}: ${state?.fault || (state?.file ? say("captures.records", { size: text }) : say("captures.not"))}`);
}

/** Open one of the panels, or none. Opening the open one closes it. */
function openPanel(name) {
  for (const each of PANELS) {
    const open = each === name && the(each).hidden;
    const button = the(`open-${each}`);
    if (!the(each).hidden && !open && the(each).contains(document.activeElement)) button.focus();
    the(each).hidden = !open;
    button.setAttribute("aria-expanded", String(open));
    if (!open) continue;
    const close = make("button", { type: "button", class: "round", "aria-label": say("close"), onclick: () => openPanel(null) }, "✕");
    the(each).replaceChildren(make("header", {}, make("h2", {}, say(`${each}.title`)), each === "log" ? logChoice() : "", close));
    delete the(each).dataset.seen;
    if (each === "captures") captures.open();
    close.focus();
  }
  live.send({ do: "log", on: name === "log" && !the("log").hidden });
}

for (const name of PANELS) the(`open-${name}`).addEventListener("click", () => openPanel(name));
document.addEventListener("keydown", (event) => event.key === "Escape" && !drive.driving && openPanel(null));
for (const button of document.querySelectorAll(".tabs button")) {
  button.addEventListener("click", () => {
    app.dataset.tab = button.dataset.tab;
    for (const one of document.querySelectorAll(".tabs button")) one.setAttribute("aria-pressed", String(one === button));
  });
}
the("cancel").addEventListener("click", () => tasks.cancel());
the("release").addEventListener("click", async () => {
  if (performance.now() - releasableMs < TOO_SOON_MS) return; // a press that was meant for STOP
  if (accepted(await live.ask({ do: "reset" }))) announce(say("stop.released"));
});
document.addEventListener("visibilitychange", () => live.send({ do: "pictures", on: shown === live && !document.hidden }));

/** Colours of canvases follow the theme. */
function repaint() {
  forgetColours();
  view.draw();
  map.paint();
}

the("theme").addEventListener("click", () => {
  const next = THEMES[(THEMES.indexOf(document.documentElement.dataset.theme) + 1) % THEMES.length];
  document.documentElement.dataset.theme = next;
  keep("theme", next);
  label();
  announce(say(`theme.${next}`));
  repaint();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
the("language").addEventListener("click", async () => {
  const next = LANGUAGES[(LANGUAGES.indexOf(document.documentElement.lang) + 1) % LANGUAGES.length];
  await speak(next, { remember: true });
  label();
  openPanel(null);
  greet();
  player.render();
  linkState(the("link-state").dataset.state, player.what);
  repaint();
});

function label() {
  const theme = say(`theme.${document.documentElement.dataset.theme}`);
  the("theme").setAttribute("aria-label", `${say("theme")}: ${theme}`);
  the("theme").title = theme;
  const other = LANGUAGES[(LANGUAGES.indexOf(document.documentElement.lang) + 1) % LANGUAGES.length];
  the("language").textContent = other.toUpperCase();
  the("language").setAttribute("aria-label", say("language"));
  the("open-log").setAttribute("aria-label", say("log.title"));
}

label();
linkState("waits");
drive.render();
