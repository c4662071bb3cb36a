// One WebSocket to the cockpit service, which comes back by itself. It holds no queue: what cannot go now does not go.
const FIRST_WAIT_MS = 250;
const LONGEST_WAIT_MS = 3000;
const ANSWER_MS = 8000;
const SILENCE_MS = 2500;
/** A state comes ten times a second; after so long without anything the connection counts as lost. */

export class Link {
  /** `path`: of the socket, with its question. `returns`: whether it opens again after it was lost. */
  constructor(path, { returns = true } = {}) {
    this.path = path;
    this.returns = returns;
    this.listeners = new Map();
    this.waiting = new Map();
    this.number = 0;
    this.waitMs = FIRST_WAIT_MS;
    this.socket = null;
    this.heardMs = 0;
    this.ended = false;
    this.watch = setInterval(() => this.#watch(), 500);
    this.open();
  }

  /** Call `listener(message, data)` for each message of that kind: the server's kinds, `picture`, `open` and `lost`. */
  on(kind, listener) {
    if (!this.listeners.has(kind)) this.listeners.set(kind, []);
    this.listeners.get(kind).push(listener);
    return this;
  }

  get isOpen() {
    return this.socket !== null && this.socket.readyState === WebSocket.OPEN;
  }

  /** Bytes that were given to the browser and are not yet on the network. */
  get waitingBytes() {
    return this.socket === null ? 0 : this.socket.bufferedAmount;
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${this.path}`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.heardMs = performance.now();
      this.waitMs = FIRST_WAIT_MS;
      this.#tell("open", {});
    };
    socket.onmessage = (event) => {
      if (socket !== this.socket) return;
      this.heardMs = performance.now();
      if (typeof event.data === "string") this.#take(JSON.parse(event.data));
      else this.#takePicture(event.data);
    };
    socket.onclose = (event) => this.#lost(socket, event);
  }

  /** Send one message now. Returns whether it went. */
  send(message) {
    if (!this.isOpen) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /** Send a message that names a picture. Its stamp has more digits than a number of JavaScript. */
  sendWithStamp(message, stamp) {
    if (!this.isOpen) return false;
    this.socket.send(JSON.stringify(message).replace('"#stamp"', stamp));
    return true;
  }

  /** Send a request, and wait for its reply. A connection that is lost meanwhile replies `ok: false`. */
  ask(message, stamp = "") {
    const id = ++this.number;
    return new Promise((resolve) => {
      const late = setTimeout(() => this.#reply({ id, ok: false, text: "", lost: true }), ANSWER_MS);
      this.waiting.set(id, { resolve, late });
      if (!this.sendWithStamp({ ...message, id }, stamp)) this.#reply({ id, ok: false, text: "", lost: true });
    });
  }

  close() {
    this.ended = true;
    clearInterval(this.watch);
    this.socket?.close();
  }

  #tell(kind, message, data) {
    for (const listener of this.listeners.get(kind) ?? []) listener(message, data);
  }

  #take(message) {
    if (message.kind === "reply") this.#reply(message);
    else this.#tell(message.kind, message);
  }

  #takePicture(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const text = new TextDecoder().decode(new Uint8Array(buffer, 4, length));
    const header = JSON.parse(text);
    header.stamp = /"stamp_ns"\s*:\s*(\d+)/.exec(text)?.[1] ?? "0";
    this.#tell("picture", header, new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" }));
  }

  #reply(message) {
    const asked = this.waiting.get(message.id);
    if (!asked) return;
    this.waiting.delete(message.id);
    clearTimeout(asked.late);
    asked.resolve(message);
  }

  #watch() {
    if (document.hidden || !this.isOpen || performance.now() - this.heardMs < SILENCE_MS) return;
    const socket = this.socket;
    socket.close(); // a dead network would let it wait for minutes
    this.#lost(socket, { code: 0, reason: "" });
  }

  #lost(socket, event) {
    if (socket !== this.socket) return;
    this.socket = null;
    for (const id of [...this.waiting.keys()]) this.#reply({ id, ok: false, text: "", lost: true });
    this.#tell("lost", { code: event.code, reason: event.reason });
    if (!this.returns || this.ended) return;
    setTimeout(() => !this.ended && this.open(), this.waitMs);
    this.waitMs = Math.min(this.waitMs * 2, LONGEST_WAIT_MS);
  }
}
