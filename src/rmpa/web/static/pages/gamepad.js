// A gamepad as the stick of the page Drive (w3.org/TR/gamepad): which of its axes drive, and a dead man's button that
// must be held. What the user chooses is kept in this browser, for each kind of gamepad.

import { html, useEffect, useRef, useState } from "../markup.js";
import { toggled } from "../plot.js";
import { store, stored } from "../storage.js";

const POLL = 50; // milliseconds between two looks at the gamepad; 500 while there is none
const ASLEEP = 10; // seconds without any change, after which a gamepad whose button is held may be out of reach
const DEAD_ZONE = 0.08; // of an axis: worn sticks do not come back to zero
const MOVED = 0.7; // how far an axis is moved, or a button pressed, to be chosen
const KEPT = "rmpa.gamepads";
const MOST = 16; // kinds of gamepads that are kept
// The left stick and the left shoulder button of a standard gamepad. An axis is positive to the right and downwards.
const FIRST = { hold: 4, forward: 1, turn: 0, side: -1, reversed: [] };
const AXES = [
  ["forward", "Forwards"],
  ["turn", "Turn"],
  ["side", "Sideways"],
];

const whole = (value, least) => Number.isInteger(value) && value >= least && value < 64;

// The mapping of a kind of gamepad: what is kept, as far as it can be one.
export function mappingOf(id, all = stored(KEPT)) {
  const found = { ...FIRST, ...(Object.hasOwn(all, id) ? all[id] : {}) };
  const fits = whole(found.hold, 0) && AXES.every(([name]) => whole(found[name], -1)) && Array.isArray(found.reversed);
  return fits ? found : FIRST;
}

function keep(id, mapping) {
  const others = Object.entries(stored(KEPT)).filter(([each]) => each !== id);
  store(KEPT, Object.fromEntries([...others.slice(1 - MOST), [id, mapping]]));
}

const isDown = (button) => Boolean(button) && (button.pressed || button.value > 0.5);

// What the axes say by a mapping: forwards, to the right and to the left side are positive.
export function tilt(pad, mapping) {
  const read = (name, sign) => {
    const value = pad.axes[mapping[name]] || 0;
    const far = Math.max(0, Math.abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE);
    const turned = mapping.reversed.includes(name) ? -sign : sign;
    return Math.min(1, far) * Math.sign(value) * turned || 0;
  };
  return { x: read("turn", 1), y: read("forward", -1), side: read("side", -1) };
}

const seen = () => [...(navigator.getGamepads?.() || [])].filter((each) => each?.connected);

export function Gamepad({ on, hold, raw }) {
  const [pad, setPad] = useState(null);
  const [mapping, setMapping] = useState(FIRST);
  const [learns, setLearns] = useState("");
  const [problem, setProblem] = useState("");
  const facts = useRef({}); // whether the button was seen up, since when the gamepad is the same
  const now = useRef();
  now.current = { on, mapping, learns, raw };
  const change = (next) => {
    setMapping(next);
    keep(pad.id, next);
  };
  const choose = useRef();
  choose.current = change;

  useEffect(() => {
    let timer;
    const look = () => {
      const found = document.hidden ? undefined : seen()[0];
      timer = setTimeout(look, found ? POLL : POLL * 10);
      if (!found) {
        if (facts.current.id) setProblem("The gamepad is gone.");
        facts.current = {};
        hold.end("gamepad");
        setPad(null);
        return;
      }
      if (found.id !== facts.current.id) {
        facts.current = { id: found.id, at: Date.now(), rest: [...found.axes] };
        setMapping(mappingOf(found.id));
        setProblem("");
      }
      if (found.timestamp !== facts.current.stamp) {
        Object.assign(facts.current, { stamp: found.timestamp, at: Date.now() });
        setPad({ id: found.id, axes: [...found.axes], buttons: found.buttons.map(isDown) });
      }
      if (now.current.learns) learn(found);
      else drive(found);
    };
    const learn = (found) => {
      const { mapping: before, learns: name } = now.current;
      const at =
        name === "hold"
          ? found.buttons.findIndex(isDown)
          : found.axes.findIndex((value, n) => Math.abs(value - (facts.current.rest[n] || 0)) > MOVED);
      if (at < 0) return;
      choose.current({ ...before, [name]: at });
      setLearns("");
    };
    const drive = (found) => {
      const is = facts.current;
      const { mapping: chosen } = now.current;
      if (is.holds && hold.by() !== "gamepad") Object.assign(is, { holds: false, up: false }); // it was ended
      if (!isDown(found.buttons[chosen.hold])) {
        Object.assign(is, { up: true, holds: false });
        hold.end("gamepad");
      } else if (is.up && now.current.on) {
        if (Date.now() - is.at > ASLEEP * 1000) {
          Object.assign(is, { up: false, holds: false });
          hold.end("gamepad");
          setProblem(`The gamepad has not changed for ${ASLEEP} s. Let its button go, and press it again.`);
          return;
        }
        const all = { axes: found.axes.map((value) => -value || 0), buttons: found.buttons.map(isDown) };
        hold.move("gamepad", { ...tilt(found, chosen), ...(now.current.raw && all) });
        is.holds = hold.by() === "gamepad";
        if (is.holds) setProblem("");
      } else if (!now.current.on) is.up = false; // a button that is down already does not drive when the stick is taken
    };
    look();
    addEventListener("gamepadconnected", look);
    addEventListener("gamepaddisconnected", look);
    return () => {
      clearTimeout(timer);
      removeEventListener("gamepadconnected", look);
      removeEventListener("gamepaddisconnected", look);
      hold.end("gamepad");
    };
  }, []);

  const note = problem && html`<p class="failure" role="alert">${problem}</p>`;
  if (!navigator.getGamepads)
    return html`<p class="muted">Browsers give gamepads only to pages of HTTPS, or of this computer.</p>`;
  if (!pad)
    return html`${note}
      <p class="muted">Connect a gamepad, and press one of its buttons.</p>`;
  return html`${note}
    <p class="muted">${pad.id}</p>
    <div class="pad">
      <ul class="axes" aria-label="Axes">
        ${pad.axes.map(
          (value, n) =>
            html`<li key=${n} class="mono">
              ${n}<svg viewBox="-50 0 100 12" preserveAspectRatio="none" aria-hidden="true">
                <path class="cross" d="M-50 6H50M0 0V12" />
                <rect x=${Math.min(0, value * 50)} y="2" width=${Math.abs(value) * 50} height="8" /></svg
              >${value.toFixed(2)}
            </li>`,
        )}
      </ul>
      <ul class="buttons" aria-label="Buttons">
        ${pad.buttons.map(
          (down, n) =>
            html`<li key=${n} class="${down ? "down" : ""} ${n === mapping.hold ? "chosen" : ""}">
              ${n}<span class="unseen">${down ? " is pressed" : ""}</span>
            </li>`,
        )}
      </ul>
    </div>
    <p>
      Hold button <strong>${mapping.hold}</strong>${raw ? "; all axes and buttons are sent" : ""}:${" "}
      ${pad.buttons[mapping.hold] ? "it is held." : on ? "nothing moves until then." : "first take the stick."}
    </p>
    <details>
      <summary>Choose the button and the axes</summary>
      <div class="form">
        <div class="row">
          <span class="grow">Dead man's button: ${mapping.hold}</span>
          <button type="button" onClick=${() => setLearns("hold")}>
            ${learns === "hold" ? "Press it now …" : "Choose"}
          </button>
        </div>
        ${AXES.map(
          ([name, title]) =>
            html`<div class="row" key=${name}>
              <span class="grow">${title}: ${mapping[name] < 0 ? "none" : `axis ${mapping[name]}`}</span>
              <label class="row"
                ><span
                  ><input
                    type="checkbox"
                    checked=${mapping.reversed.includes(name)}
                    onChange=${() => change({ ...mapping, reversed: toggled(mapping.reversed, name) })}
                  />${" "}reverse<span class="unseen"> ${title}</span></span
                ></label
              >
              <button type="button" aria-label=${`Choose ${title}`} onClick=${() => setLearns(name)}>
                ${learns === name ? "Move it now …" : "Choose"}
              </button>
            </div>`,
        )}
        <button type="button" onClick=${() => (setLearns(""), change(FIRST))}>As at first</button>
      </div>
    </details>`;
}
