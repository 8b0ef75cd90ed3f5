// The page is loaded again where one of its scripts did not come: the network changed meanwhile, as when a laptop
// joins a Wi-Fi. A script of its own, since a module that fails runs nothing of what it imports.

const AGAIN = 2000; // milliseconds
addEventListener(
  "error",
  ({ target }) => target instanceof HTMLScriptElement && setTimeout(() => location.reload(), AGAIN),
  true,
);
