// A joystick for a robot. It drives only while it is held; the server stops the robot 0.3 s after the last command.

import { html, useEffect, useRef, useState } from "../markup.js";
import { sentence } from "../format.js";
import { entries } from "../state.js";
import { Page, Panel, Since } from "../parts.js";

const PERIOD = 100; // milliseconds between two commands
const TYPE = "geometry_msgs/Twist";
const TYPED = 400; // milliseconds after the last key until a topic counts as written
const KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };

const HELD =
  "It drives only while the stick is held. " +
  "If you let go, lose the connection or leave the page, the robot is stopped within 0.3 s.";
const DENIED = "This page may not drive. Start rmpa web with --drive, and open the address that it prints.";

export function DrivePage({ state, connection }) {
  const topics = entries(state, "topics")
    .filter(([, one]) => one.type === TYPE)
    .map(([name]) => name);
  const [topic, setTopic] = useState("/cmd_vel");
  const [share, setShare] = useState(0.15);
  const fastest = connection.hello.fastest || { linear: 0, angular: 0 };
  const allowed = connection.may("drive");
  const stick = connection.stick?.topic === topic ? connection.stick : {};
  const order = (want) => connection.orderStick(topic, want);
  useEffect(() => {
    const timer = setTimeout(order, connection.driven ? TYPED : 0, "look");
    return () => clearTimeout(timer);
  }, [topic]);
  useEffect(() => () => connection.orderStick("", "look"), []);
  const hold = useRef(0); // the server drops old commands, and those of an earlier hold
  return html`<${Page} title="Drive" kind="A joystick for geometry_msgs/Twist"
    ><div class="grid">
      <${Panel} title="What is driven"
        ><div class="form">
          <label
            >Topic<input
              class="mono"
              list="twists"
              value=${topic}
              onInput=${(event) => {
                if (stick.mine) order("leave");
                setTopic(event.target.value);
              }} /></label
          ><datalist id="twists">${topics.map((each) => html`<option key=${each} value=${each} />`)}</datalist>
          <label
            >Fastest: ${(share * fastest.linear).toFixed(2)} m/s, ${(share * fastest.angular).toFixed(2)} rad/s<input
              type="range"
              min="0.05"
              max="1"
              step="0.05"
              value=${share}
              onInput=${(event) => setShare(Number(event.target.value))}
          /></label>
          <label class="row"
            ><span
              ><input
                type="checkbox"
                checked=${Boolean(stick.mine)}
                disabled=${!allowed || (stick.holder && !stick.mine)}
                onChange=${(event) => order(event.target.checked ? "take" : "leave")}
              />${" "}The robot may move: I see it</span
            ></label
          >
          <${Holder} stick=${stick} allowed=${allowed} order=${order} />
          <p class="muted">${allowed ? HELD : DENIED}</p>
        </div><//
      >
      <${Panel} title="Joystick"
        ><button type="button" class="stop" disabled=${connection.phase !== "open"} onClick=${() => order("stop")}>
          Stop the robot</button
        ><${Stick}
          on=${allowed && stick.mine}
          take=${() => {
            connection.endHold();
            hold.current = ++connection.counter;
          }}
          send=${(linear, angular) =>
            connection.send({
              op: "drive",
              topic,
              linear: linear * share,
              angular: angular * share,
              hold: hold.current,
              n: ++connection.counter,
              at: connection.serverTime(),
            })}
          release=${() => {
            connection.send({ op: "release", hold: hold.current });
            connection.endHold();
          }}
      /><//></div
  ><//>`;
}

// Who has the stick; one press takes it over.
function Holder({ stick, allowed, order }) {
  const { holder, mine, problem } = stick;
  return html`<div class="holder" role="status">
      ${mine
        ? "This page has the stick."
        : holder
          ? html`<span
                ><strong>${holder.by} at ${holder.module}</strong> has the stick, for${" "}
                <${Since} moment=${holder.since} />.</span
              ><button type="button" disabled=${!allowed} onClick=${() => order("over")}>Take over</button>`
          : "The stick is free."}
    </div>
    ${problem && html`<p class="muted">${sentence(problem)}</p>`}`;
}

function Stick({ on, take, send, release }) {
  const [at, setAt] = useState({ x: 0, y: 0 });
  const held = useRef(null),
    pad = useRef(),
    pressed = useRef(new Set());
  const stop = () => {
    if (!held.current) return;
    clearInterval(held.current.timer);
    held.current = null;
    pressed.current.clear();
    setAt({ x: 0, y: 0 });
    release();
  };
  const go = (x, y) => {
    const far = Math.max(1, Math.hypot(x, y));
    const next = { x: x / far, y: y / far };
    setAt(next);
    // The timer sends it: pointers move 60 times a second.
    if (held.current) return void Object.assign(held.current, next);
    held.current = { ...next, timer: setInterval(() => command.current(held.current.y, -held.current.x), PERIOD) };
    take();
    send(next.y, -next.x);
  };
  const command = useRef(send); // the newest: the timer outlives a change of the fastest speed
  command.current = send;
  const end = useRef(stop);
  end.current = stop;
  useEffect(() => {
    const leave = () => end.current();
    addEventListener("blur", leave);
    document.addEventListener("visibilitychange", leave);
    return () => {
      leave();
      removeEventListener("blur", leave);
      document.removeEventListener("visibilitychange", leave);
    };
  }, []);
  useEffect(() => {
    if (!on) end.current();
  }, [on]);
  const point = (event) => {
    const box = pad.current.getBoundingClientRect();
    go(((event.clientX - box.left) / box.width - 0.5) * 2.6, -((event.clientY - box.top) / box.height - 0.5) * 2.6);
  };
  const keys = () =>
    [...pressed.current].reduce(([x, y], key) => [x + KEYS[key][0] * 0.6, y + KEYS[key][1] * 0.6], [0, 0]);
  return html`<svg
      ref=${pad}
      class="stick ${on ? "" : "off"}"
      viewBox="-130 -130 260 260"
      tabindex=${on ? 0 : -1}
      role="application"
      aria-label=${on ? "Joystick: hold, or press the arrow keys" : "Joystick, off"}
      aria-disabled=${String(!on)}
      onPointerDown=${(event) => {
        if (on) {
          event.preventDefault();
          pad.current.focus();
          pad.current.setPointerCapture(event.pointerId);
          point(event);
        }
      }}
      onPointerMove=${(event) => held.current && event.buttons && point(event)}
      onPointerUp=${stop}
      onPointerCancel=${stop}
      onLostPointerCapture=${stop}
      onBlur=${stop}
      onKeyDown=${(event) => {
        if (on && KEYS[event.key]) {
          event.preventDefault();
          if (!event.repeat) {
            pressed.current.add(event.key);
            go(...keys());
          }
        }
      }}
      onKeyUp=${(event) => {
        if (pressed.current.delete(event.key)) {
          if (pressed.current.size) go(...keys());
          else stop();
        }
      }}
    >
      <circle class="base" r="100" />
      <path class="cross" d="M-100 0H100M0-100V100" />
      <circle class="knob" cx=${at.x * 70} cy=${-at.y * 70} r="34" />
    </svg>
    <p class="muted mono" aria-live="off">forward ${(at.y * 100).toFixed(0)} %, turn ${(-at.x * 100).toFixed(0)} %</p>`;
}
