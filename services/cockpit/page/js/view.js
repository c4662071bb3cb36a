// The robot's picture with its marks. It shows the newest one or says how old that is; it never makes up for lost ones.
import { fitted, rem, the, write } from "./dom.js";
import { called, number, say } from "./words.js";

const OLD_S = 0.7;
const VEILED_S = 2.0;
const STEP_PX = 12;

export class View {
  /** `onPoint(u, v, x, y)`: a place of the picture was pointed at; x, y in CSS pixels within the section. */
  constructor(onPoint) {
    this.canvas = the("picture");
    this.header = null;
    this.image = null;
    this.shownMs = 0;
    this.cross = null;
    this.aimed = null;
    this.drivingKeys = false;
    this.isPlay = false;
    this.onPoint = onPoint;
    this.canvas.addEventListener("click", (event) => this.#click(event));
    this.canvas.addEventListener("pointermove", (event) => this.#hover(event));
    this.canvas.addEventListener("pointerleave", () => this.#aim(null));
    this.canvas.addEventListener("keydown", (event) => this.#key(event));
    this.canvas.addEventListener("blur", () => ((this.cross = null), this.draw()));
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    setInterval(() => this.#tellAge(), 200);
  }

  /** Show a picture. Returns when it is on the screen, or was left out for a newer one. */
  async take(header, blob) {
    const image = await createImageBitmap(blob);
    await new Promise((resolve) => requestAnimationFrame(resolve));
    this.image?.close();
    [this.header, this.image, this.shownMs] = [header, image, performance.now()];
    this.draw();
    this.#tellAge();
  }

  /** Forget the picture: another source follows. */
  clear() {
    this.image?.close();
    [this.header, this.image] = [null, null];
    this.draw();
    this.#tellAge();
  }

  /** The objects in the picture. */
  get labels() {
    return this.header === null || this.ageS > VEILED_S ? [] : this.header.marks.detections.map((found) => found.label);
  }

  get ageS() {
    const then = Math.max(0, (this.header.now_ns - this.header.stamp_ns) / 1e9);
    return this.isPlay ? then : then + (performance.now() - this.shownMs) / 1000;
  }

  draw() {
    const { width, height, ratio } = fitted(this.canvas);
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    if (this.image === null || width === 0) return;
    const place = this.#place(width, height);
    const box = [place.x, place.y, this.header.width * place.scale, this.header.height * place.scale];
    context.save();
    context.beginPath();
    context.roundRect(...box, 0.75 * rem());
    context.clip();
    context.imageSmoothingQuality = "high";
    context.drawImage(this.image, ...box);
    context.restore();
    this.#putAge(place);
    const at = ([u, v]) => [place.x + (u + 0.5) * place.scale, place.y + (v + 0.5) * place.scale];
    const { marks } = this.header;
    if (marks.way?.length > 1) this.#way(context, marks.way.map(at));
    if (marks.goal) this.#ring(context, at(marks.goal));
    for (const found of marks.detections) this.#detection(context, found, at);
    if (marks.hand) this.#hand(context, at(marks.hand));
    if (this.cross) this.#crosshair(context, at(this.cross));
  }

  /** Where the picture lies within the canvas, and CSS pixels per pixel of it. */
  #place(width, height) {
    const scale = Math.min(width / this.header.width, height / this.header.height);
    return { scale, x: (width - this.header.width * scale) / 2, y: (height - this.header.height * scale) / 2 };
  }

  /** The age stands in the picture's corner. */
  #putAge({ x, y }) {
    const age = the("age");
    const [left, top] = [`${Math.round(x + 0.6 * rem())}px`, `${Math.round(y + 0.5 * rem())}px`];
    if (age.style.left !== left) age.style.left = left;
    if (age.style.top !== top) age.style.top = top;
  }

  #line(context, colourName, width) {
    context.lineWidth = width;
    context.strokeStyle = colourName;
    context.lineJoin = context.lineCap = "round";
  }

  #way(context, points) {
    const unit = rem() / 16;
    for (const [shade, width] of [["#0007", 7], ["#62c6cf", 4]]) {
      this.#line(context, shade, width * unit);
      context.beginPath();
      points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.stroke();
    }
  }

  #ring(context, [x, y]) {
    const unit = rem() / 16;
    for (const [shade, width] of [["#0007", 6], ["#62c6cf", 3]]) {
      this.#line(context, shade, width * unit);
      context.beginPath();
      context.ellipse(x, y, 16 * unit, 8 * unit, 0, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  #detection(context, found, at) {
    const unit = rem() / 16;
    const [left, top] = at([found.box[0] - 0.5, found.box[1] - 0.5]);
    const [right, bottom] = at([found.box[2] - 0.5, found.box[3] - 0.5]);
    const pad = 4 * unit;
    const aimed = this.aimed === found.label;
    for (const [shade, width] of [["#000a", 4.5], ["#ffffff", aimed ? 3.5 : 2]]) {
      this.#line(context, shade, width * unit);
      context.beginPath();
      context.roundRect(left - pad, top - pad, right - left + 2 * pad, bottom - top + 2 * pad, 6 * unit);
      context.stroke();
    }
    const text = called("object", found.label) + (found.note ? ` (${sayNote(found.note)})` : "");
    context.font = `600 ${12.5 * unit}px system-ui, sans-serif`;
    const wide = context.measureText(text).width + 12 * unit;
    const x = Math.min(Math.max(left - pad, 2), this.canvas.clientWidth - wide - 2);
    const y = top - pad > 24 * unit ? top - pad - 22 * unit : bottom + pad + 3 * unit;
    context.fillStyle = aimed ? "#ffffff" : "#000c";
    context.beginPath();
    context.roundRect(x, y, wide, 19 * unit, 5 * unit);
    context.fill();
    context.fillStyle = aimed ? "#000000" : "#ffffff";
    context.textBaseline = "middle";
    context.fillText(text, x + 6 * unit, y + 10 * unit);
  }

  #hand(context, [x, y]) {
    const unit = rem() / 16;
    for (const [shade, width] of [["#000a", 4.5], ["#ffd166", 2.2]]) {
      this.#line(context, shade, width * unit);
      context.beginPath();
      for (const side of [-1, 1]) {
        context.moveTo(x + side * 12 * unit, y - 8 * unit);
        context.lineTo(x + side * 12 * unit, y + 8 * unit);
        context.moveTo(x + side * 5 * unit, y);
        context.lineTo(x + side * 12 * unit, y);
      }
      context.stroke();
    }
  }

  #crosshair(context, [x, y]) {
    const unit = rem() / 16;
    for (const [shade, width] of [["#000a", 4.5], ["#ffffff", 2]]) {
      this.#line(context, shade, width * unit);
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(x + dx * 5 * unit, y + dy * 5 * unit);
        context.lineTo(x + dx * 15 * unit, y + dy * 15 * unit);
      }
      context.stroke();
    }
  }

  /** The pixel of the picture under a pointer; null beside the picture. */
  #pixel(event) {
    if (this.image === null) return null;
    const box = this.canvas.getBoundingClientRect();
    const place = this.#place(box.width, box.height);
    const u = (event.clientX - box.left - place.x) / place.scale - 0.5;
    const v = (event.clientY - box.top - place.y) / place.scale - 0.5;
    return u < -0.5 || v < -0.5 || u > this.header.width - 0.5 || v > this.header.height - 0.5 ? null : [u, v];
  }

  #found([u, v]) {
    const inside = ({ box }) => u >= box[0] - 3 && v >= box[1] - 3 && u <= box[2] + 3 && v <= box[3] + 3;
    return this.header.marks.detections.find(inside)?.label ?? null;
  }

  #aim(label) {
    this.canvas.classList.toggle("aims", label !== null);
    if (label !== this.aimed) {
      this.aimed = label;
      this.draw();
    }
  }

  #hover(event) {
    const pixel = event.pointerType === "touch" ? null : this.#pixel(event);
    this.#aim(pixel === null ? null : this.#found(pixel));
  }

  #click(event) {
    const pixel = this.#pixel(event);
    const box = this.canvas.getBoundingClientRect();
    if (pixel !== null) this.onPoint(...pixel, event.clientX - box.left, event.clientY - box.top);
  }

  #key(event) {
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (this.image === null || this.drivingKeys) return;
    const { width, height } = this.header;
    if (event.key in moves) {
      event.preventDefault();
      const [dx, dy] = moves[event.key].map((step) => (step * STEP_PX * (event.shiftKey ? 4 : 1) * width) / 640);
      const [u, v] = this.cross ?? [width / 2, height / 2];
      this.cross = [Math.min(width - 1, Math.max(0, u + dx)), Math.min(height - 1, Math.max(0, v + dy))];
      this.aimed = this.#found(this.cross);
      this.draw();
    } else if (event.key === "Enter" && this.cross) {
      const place = this.#place(this.canvas.clientWidth, this.canvas.clientHeight);
      this.onPoint(...this.cross, place.x + this.cross[0] * place.scale, place.y + this.cross[1] * place.scale);
    }
  }

  #tellAge() {
    const veil = the("veil");
    const age = the("age");
    const old = this.header === null || this.ageS >= VEILED_S;
    veil.hidden = !old;
    if (old) write(veil, this.header === null ? say("picture.none") : say("picture.old", { age: number(this.ageS, 1) }));
    write(age, old ? "" : `${number(this.ageS, 2)} s`);
    age.dataset.state = !old && this.ageS > OLD_S ? "warn" : "good";
  }
}

function sayNote(note) {
  return called("note", note).toLowerCase();
}
