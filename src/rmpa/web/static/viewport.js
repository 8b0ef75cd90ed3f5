// What moves a drawing: one pointer pans, two pinch, the wheel zooms where it points; arrow keys pan, + and − zoom, 0
// shows all.

const STEP = 40; // pixels of an arrow key
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOM = 1.25; // of a key
const WHEEL = 60; // pixels that one event of the wheel counts at most
const CLICK = 6; // pixels: what is pressed and moved less is a click

// `view` gives what has `pan(dx, dy)`, `zoom(factor, x, y)` and `fit()`; and, as far as it wants them, `point(x, y)`,
// where the pointer is, and `step(event, dx, dy)`, which is true where an arrow key does something else.
export function gestures(element, view) {
  const pointers = new Map();
  const place = ({ clientX, clientY }) => {
    const { left, top } = element.getBoundingClientRect();
    return { x: clientX - left, y: clientY - top, far: 0 };
  };
  const up = ({ pointerId }) => pointers.delete(pointerId);
  const on = {
    wheel(event) {
      const { x, y } = place(event);
      view().zoom(Math.exp(-Math.max(-WHEEL, Math.min(WHEEL, event.deltaY)) / 250), x, y);
      event.preventDefault();
    },
    keydown(event) {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const [dx, dy] = ARROWS[event.key] || [];
      if (dx !== undefined) view().step?.(event, -dx, -dy) || view().pan(dx * STEP, dy * STEP);
      else if (event.key === "+" || event.key === "=") view().zoom(ZOOM);
      else if (event.key === "-") view().zoom(1 / ZOOM);
      else if (event.key === "0") view().fit(true);
      else return;
      event.preventDefault();
    },
    pointerdown: (event) => pointers.set(event.pointerId, place(event)),
    pointermove(event) {
      const at = place(event),
        before = pointers.get(event.pointerId);
      view().point?.(at.x, at.y);
      if (!before) return;
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      const [dx, dy] = [at.x - before.x, at.y - before.y];
      at.far = before.far + Math.hypot(dx, dy);
      if (other) {
        const apart = (one) => Math.max(1, Math.hypot(one.x - other.x, one.y - other.y));
        view().pan(dx / 2, dy / 2);
        view().zoom(apart(at) / apart(before), (at.x + other.x) / 2, (at.y + other.y) / 2);
      } else view().pan(dx, dy);
      if (at.far > CLICK && !element.hasPointerCapture(event.pointerId)) element.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, at);
    },
    pointerup: up,
    pointercancel: up,
    pointerleave: (event) => element.hasPointerCapture(event.pointerId) || up(event),
  };
  for (const [name, act] of Object.entries(on)) element.addEventListener(name, act, { passive: false });
  return () => Object.entries(on).forEach(([name, act]) => element.removeEventListener(name, act));
}
