// What all pages are written with: Preact, and templates whose texts can be read. Names and values come from other
// programs: a character that is not seen, or that turns the reading direction, is drawn as its code.

import { Component, html as template } from "./vendor/htm-preact.js";
import { plain } from "./format.js";

export { Component, createContext, render, useContext } from "./vendor/htm-preact.js";
export { useEffect, useLayoutEffect, useRef, useState } from "./vendor/htm-preact.js";

const TEXTS = ["aria-label", "title", "placeholder"];
const done = new WeakSet(); // a part of a template is often a template of its own

function legible(node) {
  if (typeof node === "string") return plain(node);
  if (Array.isArray(node)) return node.map(legible);
  if (node === null || typeof node !== "object" || !node.props || done.has(node)) return node;
  done.add(node);
  const { props } = node;
  if (typeof node.type === "string")
    for (const name of TEXTS) if (typeof props[name] === "string") props[name] = plain(props[name]);
  if (props.children !== undefined && props.children !== null) props.children = legible(props.children);
  return node;
}

export const html = (...parts) => legible(template(...parts));

// Lists with the same elements are the same.
const same = (a, b) =>
  a === b ||
  (Array.isArray(a) && Array.isArray(b) && a.length === b.length && a.every((each, at) => same(each, b[at])));

// Draws again only when one of its properties is another object.
export function memo(draw) {
  return class extends Component {
    shouldComponentUpdate(next) {
      const keys = Object.keys({ ...next, ...this.props });
      return keys.some((key) => key !== "children" && !same(next[key], this.props[key]));
    }
    render(props) {
      return draw(props);
    }
  };
}
