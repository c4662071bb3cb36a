// The map from above: x of the odometry frame (ahead, where the robot began) is up, y is left.
import { colour, fitted, forgetColours, rem, the } from "./dom.js";
import { called } from "./words.js";
import { shade } from "./objects.js";

const TRAIL_M = 0.03;
const TRAIL_MOST = 600;
const NEAREST_M = 1.0;
const FARTHEST_M = 30.0;
const DRAG_PX = 6;

export class FloorMap {
  /** `onPoint(x, y, left, top)`: a place was pointed at; metres, and CSS pixels within the section. */
  constructor(onPoint) {
    this.canvas = the("map");
    this.onPoint = onPoint;
    this.plan = null;
    this.cells = null;
    this.raster = null;
    this.body = null;
    this.bodyM = 0.17;
    this.known = [];
    this.target = null;
    this.trail = [];
    this.viewM = 4.0;
    this.middle = null;
    this.pointers = new Map();
    this.moved = 0;
    this.cross = null;
    this.drivingKeys = false;
    const on = (kind, listener) => this.canvas.addEventListener(kind, listener);
    on("pointerdown", (event) => this.#down(event));
    on("pointermove", (event) => this.#move(event));
    on("pointerup", (event) => this.#up(event));
    on("pointercancel", (event) => this.pointers.delete(event.pointerId));
    on("keydown", (event) => this.#key(event));
    on("blur", () => ((this.cross = null), this.draw()));
    this.canvas.addEventListener("wheel", (event) => (event.preventDefault(), this.zoom(event.deltaY > 0 ? 1.15 : 1 / 1.15)), { passive: false });
    the("zoom-in").addEventListener("click", () => this.zoom(1 / 1.5));
    the("zoom-out").addEventListener("click", () => this.zoom(1.5));
    the("recentre").addEventListener("click", () => ((this.middle = null), this.draw()));
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  /** Take a message `map`. */
  async take(plan) {
    this.plan = plan;
    const packed = Uint8Array.from(atob(plan.cells), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const cells = new Uint8Array(await new Response(stream).arrayBuffer());
    if (plan === this.plan && cells.length === plan.width * plan.height) {
      this.cells = cells;
      this.paint();
    }
  }

  /** Take the plan of a message `state`. */
  see(plan) {
    this.known = plan?.known ?? [];
    this.target = plan?.target ?? null;
    this.body = plan?.body ?? null;
    if (this.body) {
      const last = this.trail.at(-1);
      if (!last || Math.hypot(last[0] - this.body[0], last[1] - this.body[1]) > TRAIL_M) this.trail.push(this.body.slice(0, 2));
      if (this.trail.length > TRAIL_MOST) this.trail.shift();
    }
    this.draw();
  }

  clear() {
    [this.plan, this.cells, this.raster, this.body, this.known, this.trail, this.middle] = [null, null, null, null, [], [], null];
    this.draw();
  }

  /** Draw the cells anew, with the colours of now. */
  paint() {
    forgetColours();
    if (this.cells !== null) {
      const { width, height } = this.plan;
      const tones = ["unknown", "free", "wall"].map((name) => colour(name).match(/[\d.]+/g).map(Number));
      const image = new ImageData(height, width); // its rows are x, from far to near; its columns are y, from left to right
      for (let row = 0; row < height; row++) {
        for (let column = 0; column < width; column++) {
          const tone = tones[this.cells[row * width + column]] ?? tones[0];
          const at = 4 * ((width - 1 - column) * height + (height - 1 - row));
          [image.data[at], image.data[at + 1], image.data[at + 2], image.data[at + 3]] = [tone[0], tone[1], tone[2], 255];
        }
      }
      this.raster ??= document.createElement("canvas");
      [this.raster.width, this.raster.height] = [height, width];
      this.raster.getContext("2d").putImageData(image, 0, 0);
    }
    this.draw();
  }

  zoom(factor) {
    this.viewM = Math.min(FARTHEST_M, Math.max(NEAREST_M, this.viewM * factor));
    this.draw();
  }

  draw() {
    const { width, height, ratio } = fitted(this.canvas);
    if (width === 0 || height === 0) return;
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = colour("unknown");
    context.fillRect(0, 0, width, height);
    const scale = Math.min(width, height) / this.viewM;
    const [mx, my] = this.middle ?? this.body ?? [0, 0];
    this.frame = { scale, mx, my, width, height };
    const at = ([x, y]) => [width / 2 - (y - my) * scale, height / 2 - (x - mx) * scale];
    if (this.raster && this.plan) this.#cells(context, at, scale);
    const unit = rem() / 16;
    this.#path(context, this.trail.map(at), colour("soft"), 1.5 * unit, [2 * unit, 5 * unit]);
    if (this.plan?.way?.length > 1) this.#path(context, this.plan.way.map(at), colour("accent"), 3 * unit, []);
    if (this.plan?.goal) this.#goal(context, at(this.plan.goal), unit);
    for (const item of this.known) this.#object(context, item, at, scale, unit);
    if (this.body) this.#robot(context, at(this.body), scale, unit);
    this.#ruler(context, scale, unit, height);
    if (this.cross) this.#crosshair(context, at(this.cross), unit);
  }

  #cells(context, at, scale) {
    const { cell_m: cell, origin, width, height } = this.plan;
    const [left, top] = at([origin[0] + width * cell, origin[1] + height * cell]);
    context.imageSmoothingEnabled = scale * cell < 3;
    context.drawImage(this.raster, left, top, height * cell * scale, width * cell * scale);
  }

  #path(context, points, tone, width, dash) {
    context.setLineDash(dash);
    context.lineWidth = width;
    context.lineJoin = context.lineCap = "round";
    context.strokeStyle = tone;
    context.beginPath();
    points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
    context.setLineDash([]);
  }

  #goal(context, [x, y], unit) {
    context.lineWidth = 2.5 * unit;
    context.strokeStyle = colour("accent");
    context.beginPath();
    context.arc(x, y, 7 * unit, 0, 2 * Math.PI);
    context.stroke();
  }

  #object(context, item, at, scale, unit) {
    const [x, y] = at([item.x, item.y]);
    const fresh = item.age_s < 2;
    context.globalAlpha = 0.18;
    context.fillStyle = colour("accent");
    context.beginPath();
    context.arc(x, y, Math.min(2, 2 * (item.sigma_m ?? 0)) * scale, 0, 2 * Math.PI);
    context.fill();
    context.globalAlpha = fresh ? 1 : 0.65;
    context.fillStyle = shade(item.label) ?? colour("soft");
    context.strokeStyle = item.label === this.target ? colour("accent") : colour("text");
    context.lineWidth = (item.label === this.target ? 3 : 1.2) * unit;
    context.beginPath();
    context.arc(x, y, Math.max(5 * unit, 0.035 * scale), 0, 2 * Math.PI);
    context.fill();
    context.stroke();
    context.font = `600 ${12 * unit}px system-ui, sans-serif`;
    context.textBaseline = "middle";
    const text = called("object", item.label);
    const right = x + context.measureText(text).width + 14 * unit > context.canvas.clientWidth;
    context.textAlign = right ? "right" : "left";
    context.lineWidth = 3 * unit;
    context.strokeStyle = colour("card");
    context.fillStyle = colour("text");
    const tx = x + (right ? -10 : 10) * unit;
    context.strokeText(text, tx, y);
    context.fillText(text, tx, y);
    context.textAlign = "left";
    context.globalAlpha = 1;
  }

  #robot(context, [x, y], scale, unit) {
    const radius = Math.max(this.bodyM * scale, 6 * unit);
    const yaw = this.body[2];
    context.save();
    context.translate(x, y);
    context.rotate(-yaw);
    context.fillStyle = colour("accent");
    context.beginPath();
    context.arc(0, 0, radius, 0, 2 * Math.PI);
    context.fill();
    context.fillStyle = colour("on-accent");
    context.beginPath();
    context.moveTo(0, -radius * 0.72);
    context.lineTo(radius * 0.42, radius * 0.3);
    context.lineTo(0, radius * 0.08);
    context.lineTo(-radius * 0.42, radius * 0.3);
    context.fill();
    context.restore();
  }

  #ruler(context, scale, unit, height) {
    const length = this.viewM > 12 ? 5 : this.viewM > 2.5 ? 1 : 0.25;
    const [x, y] = [12 * unit, height - 14 * unit];
    this.#path(context, [[x, y - 4 * unit], [x, y], [x + length * scale, y], [x + length * scale, y - 4 * unit]], colour("soft"), 1.5 * unit, []);
    context.font = `600 ${11 * unit}px system-ui, sans-serif`;
    context.fillStyle = colour("soft");
    context.fillText(`${length} m`, x + 5 * unit, y - 8 * unit);
  }

  #crosshair(context, [x, y], unit) {
    this.#path(context, [[x - 10 * unit, y], [x + 10 * unit, y]], colour("text"), 2 * unit, []);
    this.#path(context, [[x, y - 10 * unit], [x, y + 10 * unit]], colour("text"), 2 * unit, []);
  }

  #where(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** The place of the floor under that point of the canvas, metres. */
  #place([left, top]) {
    const { scale, mx, my, width, height } = this.frame;
    return [mx - (top - height / 2) / scale, my - (left - width / 2) / scale];
  }

  #down(event) {
    if (this.pointers.size === 0) this.moved = 0;
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.#where(event));
  }

  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = this.#where(event);
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (others.length === 1) {
      const far = (place) => Math.max(20, Math.hypot(place[0] - others[0][0], place[1] - others[0][1]));
      this.viewM = Math.min(FARTHEST_M, Math.max(NEAREST_M, (this.viewM * far(before)) / far(now)));
    } else if (this.moved > DRAG_PX) {
      const { scale, mx, my } = this.frame;
      this.middle = [mx + (now[1] - before[1]) / scale, my + (now[0] - before[0]) / scale];
    }
    this.pointers.set(event.pointerId, now);
    this.draw();
  }

  #up(event) {
    const known = this.pointers.delete(event.pointerId);
    if (known && this.pointers.size === 0 && this.moved <= DRAG_PX) {
      const where = this.#where(event);
      this.onPoint(...this.#place(where), ...where);
    }
  }

  #key(event) {
    const moves = { ArrowLeft: [0, 1], ArrowRight: [0, -1], ArrowUp: [1, 0], ArrowDown: [-1, 0] };
    if (event.key === "+" || event.key === "-") this.zoom(event.key === "+" ? 1 / 1.25 : 1.25);
    if (!this.frame || this.drivingKeys) return;
    const { scale, mx, my, width, height } = this.frame;
    if (event.key in moves) {
      event.preventDefault();
      const [dx, dy] = moves[event.key].map((step) => step * this.viewM * (event.shiftKey ? 0.1 : 0.025));
      const [x, y] = this.cross ?? [mx, my];
      this.cross = [x + dx, y + dy];
      this.draw();
    } else if (event.key === "Enter" && this.cross) {
      this.onPoint(...this.cross, width / 2 - (this.cross[1] - my) * scale, height / 2 - (this.cross[0] - mx) * scale);
    }
  }
}
