// One WebSocket to `rmpa web`: the state, live messages, and questions (docs/design/monitor-protocol.md).

import { adopt, applyPatch } from "./state.js";

const FIRST_WAIT = 300; // milliseconds until the next attempt, doubled up to LAST_WAIT
const LAST_WAIT = 5000;
const ANSWER_WAIT = 30000;
const SEEN_GATHER = 40; // milliseconds in which pictures that are drawn are told together
const TICKS = 10; // of which the fastest counts: over 20 s two clocks do not drift apart
// Milliseconds without a word after which the connection is lost, or the attempt given up; a tick comes every 2 s.
const SILENT = 7000;

const shown = (what) => (to, message) => {
  to[what] = message;
  to.changed();
};
const toWatch = (to, message) => to.watches.get(message.id)?.sink(message);
// What a message of the server is to a connection.
const RECEIVE = {
  hello: (to, message) => (to.tick(message.at), shown("hello")(to, message)),
  tick: (to, { at }) => to.tick(at),
  state: (to, { state, n }) => to.shown(n, adopt(state)),
  patch(to, { patch, n }) {
    to.frames.patches += 1;
    to.shown(n, applyPatch(to.state, patch));
  },
  value: toWatch,
  points: toWatch,
  tf: toWatch,
  beat: toWatch,
  published: (to, message) => to.publishing.get(message.id)?.(message),
  answer: (to, { id, value }) => to.settle(id)?.resolve(value),
  stick(to, message) {
    if (message.mine && !to.stick?.mine) to.notice = null; // of how this page lost it before
    shown("stick")(to, message);
  },
  driven: shown("commanded"),
  failed: (to, message) => to.failed(message),
};

export class Connection {
  constructor(changed) {
    this.changed = changed; // called after each change that a page can show
    this.phase = "connecting"; // connecting, open, lost
    this.lostAt = 0;
    this.state = null;
    this.hello = { may: [], agent: "" };
    this.looks = [];
    this.watches = new Map();
    this.questions = new Map();
    this.publishing = new Map(); // what tells the form of each publication
    this.notice = null;
    this.driven = ""; // the topic whose joystick is shown
    this.stick = null; // who has its stick
    this.commanded = null; // what the server commands for this page, while its stick is held
    this.counter = 0;
    this.seen = []; // watches whose pictures have been drawn since that was told
    this.wait = FIRST_WAIT;
    this.frames = { patches: 0, bytes: 0 };
    this.ticks = []; // how far this page's clock was ahead of the server's at each of the last ticks, in seconds
    this.open();
    setInterval(() => this.socket && Date.now() - this.heard > SILENT && this.drop(), 1000);
    addEventListener("online", () => this.retry());
    document.addEventListener("visibilitychange", () => document.hidden || this.retry());
  }

  // What this page may do; a lost connection takes nothing from it but the joystick.
  may(right) {
    return this.hello.may.includes(right) && (right !== "drive" || this.phase === "open");
  }

  retry() {
    if (this.phase !== "lost") return;
    clearTimeout(this.timer);
    this.open();
  }

  open() {
    const url = new URL("monitor", document.baseURI);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    if (this.socket) this.socket.close(); // one that is still connecting: its events are ignored from here on
    const socket = (this.socket = new WebSocket(url, "rmpa.monitor.v1"));
    this.heard = Date.now();
    let opened = false;
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => socket === this.socket && this.receive(event.data);
    socket.onclose = (event) => socket === this.socket && this.closed(event, opened);
    socket.onopen = () => {
      if (socket !== this.socket) return;
      opened = true;
      this.heard = Date.now();
      this.ticks = [];
      this.seen = [];
      this.phase = "open";
      this.wait = FIRST_WAIT;
      if (this.looks.length) this.send({ op: "look", at: this.looks });
      for (const [id, watch] of this.watches) this.send({ op: "watch", id, ...watch.wanted });
      if (this.driven) this.orderStick(this.driven, "look");
      this.changed();
    };
  }

  closed(event, opened) {
    this.socket = this.stick = null;
    if (this.phase !== "lost") this.lostAt = Date.now();
    this.phase = "lost";
    this.reason = event.reason;
    if (!opened) this.explain();
    const failure = { error: "the connection was lost before the answer came", remedy: "Check whether it was done." };
    for (const question of this.questions.values()) {
      clearTimeout(question.timer);
      question.reject(failure);
    }
    this.questions.clear();
    const ended = { op: "failed", error: "the connection was lost: nothing more is published", remedy: "" };
    for (const sink of this.publishing.values()) sink(ended);
    this.publishing.clear();
    this.timer = setTimeout(() => this.open(), this.wait * (0.75 + Math.random() / 2));
    this.wait = Math.min(LAST_WAIT, this.wait * 2);
    this.changed();
  }

  // Nothing comes, as where the Wi-Fi has gone: the browser itself would notice much later.
  drop() {
    this.socket.close();
    this.closed({ reason: "it has said nothing for some seconds" }, true);
  }

  // A browser does not tell why a WebSocket was refused, as for a wrong token: the same question over HTTP does.
  explain() {
    const why = (problem) => problem && this.phase === "lost" && ((this.reason = problem.detail), this.changed());
    fetch(new URL("api/v1/agent", document.baseURI))
      .then((response) => (response.ok || response.status === 503 ? null : response.json()))
      .then(why, () => {});
  }

  send(message) {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  receive(data) {
    this.heard = Date.now();
    if (typeof data !== "string") return this.receiveBinary(data);
    this.frames.bytes += data.length;
    const message = JSON.parse(data);
    RECEIVE[message.op]?.(this, message);
  }

  tick(at) {
    this.ticks = [...this.ticks.slice(-TICKS + 1), performance.now() / 1000 - at];
  }

  // The server's clock, behind by what the fastest of the last ticks took: a command that says it is at most as old as
  // it seems.
  serverTime() {
    return this.ticks.length ? performance.now() / 1000 - Math.min(...this.ticks) : 0;
  }

  // The acknowledgement is sent when the browser has drawn: the server waits for it before it sends more than one
  // further patch.
  shown(n, state) {
    this.state = state;
    this.changed(() => this.send({ op: "ack", n }));
  }

  async receiveBinary(buffer) {
    const view = new DataView(buffer);
    if (buffer.byteLength > 12 && view.getUint8(0) === 2) return this.receiveLayer(view, buffer);
    if (buffer.byteLength < 24 || view.getUint8(0) !== 1) return;
    const short = (at) => view.getUint16(at, true);
    const id = view.getUint32(8, true);
    await this.watches.get(id)?.sink({
      op: "image",
      format: ["", "jpeg", "png", "rgb8", "mono8", "bgr8"][view.getUint8(1)],
      width: short(2),
      height: short(4),
      stamp: Number(view.getBigUint64(12, true)) / 1e9,
      whole: [short(20), short(22)],
      bytes: new Uint8Array(buffer, 24),
    });
    this.seen.push(id);
    this.tellsSeen ??= setTimeout(() => this.tellSeen(), SEEN_GATHER);
  }

  // The server sends further pictures when those that it has sent are drawn.
  tellSeen() {
    this.tellsSeen = undefined;
    this.send({ op: "seen", ids: this.seen.splice(0) });
  }

  // The picture or the points of a map's layer, behind what is said of them.
  receiveLayer(view, buffer) {
    const from = 12 + view.getUint32(8, true);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 12, from - 12)));
    this.watches.get(view.getUint32(4, true))?.sink({ op: "layer", head, body: new Uint8Array(buffer, from) });
  }

  failed(message) {
    const question = this.settle(message.id);
    if (question) question.reject(message);
    else if (this.publishing.has(message.id)) {
      const sink = this.publishing.get(message.id);
      this.publishing.delete(message.id);
      sink(message);
    } else if (this.watches.has(message.id)) this.watches.get(message.id).sink(message);
    else {
      this.notice = message;
      this.changed();
    }
  }

  settle(id) {
    const question = this.questions.get(id);
    this.questions.delete(id);
    if (question) clearTimeout(question.timer);
    return question;
  }

  look(at) {
    if (JSON.stringify(at) === JSON.stringify(this.looks)) return;
    this.looks = at;
    this.send({ op: "look", at });
  }

  // Gives messages of a topic to `sink` until the function that it returns is called.
  watch(wanted, sink) {
    const id = ++this.counter;
    this.watches.set(id, { wanted, sink });
    this.send({ op: "watch", id, ...wanted });
    return () => {
      this.watches.delete(id);
      this.send({ op: "unwatch", id });
    };
  }

  // Publishes once, or at a rate until the function that it returns is called; `sink` gets `published` and `failed`.
  publish(wanted, sink) {
    const id = ++this.counter;
    this.publishing.set(id, sink);
    this.send({ op: "publish", id, at: this.serverTime(), ...wanted });
    const renew = setInterval(() => this.publishing.has(id) && this.send({ op: "publishing", id }), 1000);
    return () => {
      clearInterval(renew);
      this.publishing.delete(id);
      if (wanted.rate) this.send({ op: "unpublish", id });
    };
  }

  ask(what, args = {}) {
    const id = ++this.counter;
    return new Promise((resolve, reject) => {
      if (this.phase !== "open")
        return reject({ error: "there is no connection to rmpa web", remedy: "Nothing was sent." });
      const timer = setTimeout(
        () => this.settle(id)?.reject({ error: "no answer came within 30 s", remedy: "" }),
        ANSWER_WAIT,
      );
      this.questions.set(id, { resolve, reject, timer });
      this.send({ op: "ask", id, what, args, at: this.serverTime() });
    });
  }

  // The answer as `{ value }`, or `{ failure }`.
  told = (what, args) =>
    this.ask(what, args).then(
      (value) => ({ value }),
      (failure) => ({ failure }),
    );

  // Shows who has the stick of a topic, takes it, takes it over, leaves it, or stops the robot.
  orderStick(topic, want, type) {
    this.driven = topic;
    this.send({ op: "stick", topic, want, ...(type && { type }) });
  }

  // What was said of one hold of the stick ends with it.
  endHold() {
    this.commanded = null;
    if (this.notice?.hold === undefined) return;
    this.notice = null;
    this.changed();
  }
}
