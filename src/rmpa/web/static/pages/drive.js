// A joystick for a robot, by touch, keys or a gamepad. It drives only while it is held; the server stops the robot
// 0.3 s after the last command.

import { html, useEffect, useRef, useState } from "../markup.js";
import { sentence } from "../format.js";
import { section } from "../state.js";
import { Page, Panel, Select, Since, Text } from "../parts.js";
import { Link, ModuleLink, NodeLink } from "../links.js";
import { useAnswer } from "../asking.js";
import { Gamepad } from "./gamepad.js";

const PERIOD = 100; // milliseconds between two commands
const TWIST = "geometry_msgs/Twist";
const JOY = "sensor_msgs/Joy";
const ASKED = 2; // seconds between two questions for the topics that can be driven
const TYPED = 400; // milliseconds after the last key until a topic counts as written
const KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };
const TILT = 0.6; // of the fastest, by a key
const REST = { x: 0, y: 0, side: 0 };
const RAMP = 1; // m/s², until another one is chosen

const HELD =
  "It drives only while the stick, an arrow key or the gamepad's dead man's button is held. If you let go, lose the " +
  "connection or leave the page, the robot is stopped within 0.3 s.";
const DENIED = "This page may not drive. Start rmpa web with --drive, and open the address that it prints.";

// The one hold of the stick, by whichever input has begun it: what it says is sent until it ends.
function useHold(on, connection, command) {
  const held = useRef(null), // the server drops old commands, and those of an earlier hold
    newest = useRef(command);
  const [at, setAt] = useState(REST);
  newest.current = command; // the timer outlives a change of the fastest speed
  const send = () => {
    const { values, hold } = held.current;
    connection.send({
      op: "drive",
      ...newest.current(values),
      hold,
      n: ++connection.counter,
      at: connection.serverTime(),
    });
  };
  const hold = useRef({
    by: () => held.current?.by,
    // The timer sends it: pointers move 60 times a second.
    move: (by, values) => {
      if (held.current && held.current.by !== by) return;
      setAt(values);
      if (held.current) return void (held.current.values = values);
      connection.endHold();
      held.current = { by, values, hold: ++connection.counter, timer: setInterval(() => send(), PERIOD) };
      send();
    },
    end: (by) => {
      if (!held.current || (by && held.current.by !== by)) return;
      clearInterval(held.current.timer);
      connection.send({ op: "release", hold: held.current.hold });
      held.current = null;
      setAt(REST);
      connection.endHold();
    },
  }).current;
  useEffect(() => {
    const leave = () => hold.end();
    addEventListener("blur", leave);
    document.addEventListener("visibilitychange", leave);
    return () => {
      leave();
      removeEventListener("blur", leave);
      document.removeEventListener("visibilitychange", leave);
    };
  }, []);
  useEffect(() => {
    if (!on) hold.end();
  }, [on]);
  return [hold, at];
}

export function DrivePage({ state, connection }) {
  const known = useAnswer(connection, "driven", {}, ASKED).value || { topics: {}, types: [TWIST] };
  const [topic, setTopic] = useState("/cmd_vel");
  const [chosen, setType] = useState(TWIST);
  const fastest = { linear: 0, angular: 0, steer: 0, acceleration: RAMP, ...connection.hello.fastest };
  const [most, setMost] = useState({ linear: 0.15, angular: 0.15, ramp: RAMP });
  const type = known.topics[topic]?.type || chosen;
  const allowed = connection.may("drive");
  const stick = connection.stick?.topic === topic ? connection.stick : {};
  const order = (want) => connection.orderStick(topic, want, type);
  const on = Boolean(allowed && stick.mine);
  const [hold, at] = useHold(on, connection, ({ x, y, side = 0, axes, buttons }) => ({
    topic,
    type,
    linear: y * most.linear,
    side: side * most.linear,
    angular: -x * most.angular,
    ramp: most.ramp,
    ...(type === JOY && { axes: axes || [-x, y], buttons: buttons || [] }),
  }));
  useEffect(() => {
    const timer = setTimeout(order, connection.driven ? TYPED : 0, "look");
    return () => clearTimeout(timer);
  }, [topic]);
  useEffect(() => () => connection.orderStick("", "look"), []);
  const stop = useRef();
  stop.current = () => (hold.end(), order("stop"));
  useEffect(() => {
    const key = (event) => event.key === "Escape" && !document.querySelector("dialog") && stop.current();
    addEventListener("keydown", key);
    return () => removeEventListener("keydown", key);
  }, []);
  const choose = (name) => {
    if (stick.mine) order("leave");
    setTopic(name);
  };
  return html`<${Page} title="Drive" kind="A joystick for any robot of the mesh"
    ><div class="grid">
      <${Panel} title="Who drives what" wide
        ><${Chain}
          ...${{ stick, topic, type }}
          nodes=${known.topics[topic]?.nodes || []}
          takers=${section(state, "topics")[topic]?.to || []}
          own=${section(state, "agent").name || connection.hello.agent}
        />
        <div class="row holder">
          <label class="row grow"
            ><span
              ><input
                type="checkbox"
                checked=${Boolean(stick.mine)}
                disabled=${!allowed || (stick.holder && !stick.mine)}
                onChange=${(event) => order(event.target.checked ? "take" : "leave")}
              />${" "}The robot may move: I see it</span
            ></label
          >${stick.holder &&
          !stick.mine &&
          html`<button type="button" disabled=${!allowed} onClick=${() => order("over")}>Take over</button>`}
          <${Stop} disabled=${connection.phase !== "open"} onClick=${() => stop.current()} />
        </div>
        ${stick.problem && html`<p class="muted">${sentence(stick.problem)}</p>`}<//
      >
      <${Panel} title="Joystick"
        ><${Stick} on=${on} hold=${hold} at=${at} /><${Commanded}
          ...${{ at, type, fastest }}
          sent=${hold.by() && connection.commanded}
        />
        <p class="muted">${allowed ? HELD : DENIED}</p><//
      >
      <div class="stacked">
        <${Panel} title="What is driven, and how fast"
          ><div class="form">
            <${Target}
              ...${{ known, topic, type }}
              fixed=${Boolean(known.topics[topic])}
              onTopic=${choose}
              onType=${setType}
            /><${Limits} type=${type} fastest=${fastest} most=${most} onMost=${setMost} /></div
        ><//>
        <${Panel} title="Gamepad"><${Gamepad} on=${on} hold=${hold} raw=${type === JOY} /><//>
      </div></div
  ><//>`;
}

const Stop = (more) => html`<button type="button" class="stop" title="Escape" ...${more}>Stop the robot</button>`;

// From the page that drives, by the topic, to the nodes that obey.
function Chain({ stick, topic, type, nodes, takers, own }) {
  const { holder, mine } = stick;
  const modules = new Map(takers.map((name) => [name, []]));
  for (const node of nodes) {
    const at = node.indexOf(":"); // MODULE:/name of a peer's
    const module = at > 0 ? node.slice(0, at) : own;
    modules.set(module, [...(modules.get(module) || []), node]);
  }
  return html`<ol class="chain">
    <li class=${holder ? "held" : ""}>
      <span class="kind">Driver</span>
      ${holder
        ? html`<strong role="status">${mine ? "This page" : `The page of ${holder.by}`}</strong>
            <span
              >${mine && `${holder.by} `}at <${ModuleLink} name=${holder.module} />, for${" "}
              <${Since} moment=${holder.since}
            /></span>`
        : html`<strong role="status">The stick is free</strong>`}
    </li>
    <li>
      <span class="kind">Topic</span><strong class="mono"><${Link} page="topic" name=${topic} /></strong
      ><span class="mono">${type}</span>
    </li>
    <li>
      <span class="kind">Driven</span>${modules.size
        ? [...modules].map(
            ([module, names]) =>
              html`<span key=${module}
                ><strong><${ModuleLink} name=${module} /></strong> ${names.map(
                  (name, n) => html`${n > 0 && ", "}<${NodeLink} name=${name}>${name.slice(name.indexOf(":") + 1)}<//>`,
                )}</span
              >`,
          )
        : html`<strong>No subscriber is known</strong>`}
    </li>
  </ol>`;
}

const Target = ({ known, topic, type, fixed, onTopic, onType }) =>
  html`<${Text} label="Topic" class="mono" list="driven" value=${topic} onInput=${onTopic} />
    <datalist id="driven">
      ${Object.entries(known.topics).map(
        ([name, each]) =>
          html`<option key=${name} value=${name}>${each.type}${each.nodes.map((node) => ` · ${node}`)}</option>`,
      )}
    </datalist>
    <${Select}
      label=${`Type${fixed ? ", which the topic has" : ""}`}
      class="mono"
      value=${type}
      disabled=${fixed}
      names=${known.types}
      onChange=${onType}
    />`;

const degrees = (angle) => `${((angle * 180) / Math.PI).toFixed(0)}°`;

function Limits({ type, fastest, most, onMost }) {
  if (type === JOY)
    return html`<p class="muted">
      A Joy message has the raw axes and buttons: what subscribes to it sets the speed, and has no ramp of this page.
    </p>`;
  const car = type.startsWith("ackermann_msgs/");
  const turn = car
    ? `Widest steering angle: ${degrees(most.angular * fastest.steer)}`
    : `Fastest turn: ${(most.angular * fastest.angular).toFixed(2)} rad/s`;
  const rows = [
    ["linear", `Fastest: ${(most.linear * fastest.linear).toFixed(2)} m/s`, 0.05, 1],
    ["angular", turn, 0.05, 1],
    ["ramp", `Acceleration: ${most.ramp.toFixed(1)} m/s²`, 0.1, fastest.acceleration],
  ];
  return rows.map(
    ([key, text, step, end]) =>
      html`<label key=${key}
        >${text}<input
          type="range"
          min=${step}
          max=${end}
          step=${step}
          value=${most[key]}
          onInput=${(event) => onMost({ ...most, [key]: Number(event.target.value) })}
      /></label>`,
  );
}

// What the stick says, and what the robot is commanded: less, while it speeds up.
function Commanded({ at, type, fastest, sent }) {
  const turn = type.startsWith("ackermann_msgs/")
    ? degrees((sent?.angular || 0) * fastest.steer)
    : `${((sent?.angular || 0) * fastest.angular).toFixed(2)} rad/s`;
  return html`<p class="muted mono" aria-live="off">
    ${`forward ${(at.y * 100).toFixed(0)} %, turn ${(-at.x * 100).toFixed(0)} %`}${type !== JOY &&
    html`<br />commanded: ${((sent?.linear || 0) * fastest.linear).toFixed(2)} m/s, ${turn}`}
  </p>`;
}

function Stick({ on, hold, at }) {
  const pad = useRef(),
    pressed = useRef(new Set());
  const stop = () => {
    pressed.current.clear();
    hold.end("stick");
  };
  const go = (x, y) => {
    const far = Math.max(1, Math.hypot(x, y));
    hold.move("stick", { x: x / far, y: y / far });
  };
  const point = (event) => {
    const box = pad.current.getBoundingClientRect();
    go(((event.clientX - box.left) / box.width - 0.5) * 2.6, -((event.clientY - box.top) / box.height - 0.5) * 2.6);
  };
  const press = (event) => {
    event.preventDefault();
    pad.current.focus();
    pad.current.setPointerCapture(event.pointerId);
    point(event);
  };
  const hit = (event) => {
    if (!KEYS[event.key]) return;
    event.preventDefault();
    if (event.repeat) return;
    pressed.current.add(event.key);
    go(...keys());
  };
  const keys = () =>
    [...pressed.current].reduce(([x, y], key) => [x + KEYS[key][0] * TILT, y + KEYS[key][1] * TILT], [0, 0]);
  return html`<svg
    ref=${pad}
    class="stick ${on ? "" : "off"}"
    viewBox="-130 -130 260 260"
    tabindex=${on ? 0 : -1}
    role="application"
    aria-label=${on ? "Joystick: hold, or press the arrow keys" : "Joystick, off"}
    aria-disabled=${String(!on)}
    onPointerDown=${on && press}
    onPointerMove=${(event) => hold.by() === "stick" && event.buttons && point(event)}
    onPointerUp=${stop}
    onPointerCancel=${stop}
    onLostPointerCapture=${stop}
    onBlur=${stop}
    onKeyDown=${on && hit}
    onKeyUp=${(event) => pressed.current.delete(event.key) && (pressed.current.size ? go(...keys()) : stop())}
  >
    <circle class="base" r="100" />
    <path class="cross" d="M-100 0H100M0-100V100" />
    <circle class="knob" cx=${at.x * 70} cy=${-at.y * 70} r="34" />
  </svg>`;
}
