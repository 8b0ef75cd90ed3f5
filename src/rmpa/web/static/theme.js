// Dark or light: as the system says, until the user chooses.

import { store, stored } from "./storage.js";

const KEY = "rmpa.theme"; // in the browser: { chosen }
const system = () => (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");

export const theme = () => document.documentElement.dataset.theme || system();

export function applyTheme() {
  const { chosen } = stored(KEY);
  if (chosen === "dark" || chosen === "light") document.documentElement.dataset.theme = chosen;
}

export function nextTheme() {
  const chosen = theme() === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = chosen;
  store(KEY, { chosen });
}

// The value of a colour, or of another property of the style.
export const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Calls `changed` when the user chooses other colours, until the function that it returns is called.
export function onTheme(changed) {
  const themes = new MutationObserver(changed);
  themes.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  return () => themes.disconnect();
}
