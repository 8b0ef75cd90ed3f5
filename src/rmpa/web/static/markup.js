// What all pages are written with: Preact, and templates whose texts can be read. Names and values come from other
// programs: a character that is not seen, or that turns the reading direction, is drawn as its code.

import { html as template } from "./vendor/htm-preact.js";
import { plain } from "./format.js";

export {
  Component,
  createContext,
  render,
  useContext,
  useEffect,
  useLayoutEffect,
  useRef,
  useState,
} from "./vendor/htm-preact.js";

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
