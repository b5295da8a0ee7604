// The page: picks the view by the address after #, and shows one at a time.

import { homeView } from "./home.js";
import { jobView } from "./job.js";

const main = document.getElementById("main");
let current = null;

function show() {
  const job = location.hash.match(/^#\/jobs\/([^/?]+)$/);
  current?.close();
  main.replaceChildren();
  current = job ? jobView(main, decodeURIComponent(job[1])) : homeView(main);
}

addEventListener("hashchange", () => {
  show();
  // Keyboard and screen-reader users go on from the top of the new view.
  main.focus();
  scrollTo(0, 0);
});
show();
