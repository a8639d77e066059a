// The page: which view is shown, by the address behind #.

import { listen } from "./api.js";
import { el } from "./dom.js";
import { Editor } from "./editor.js";
import { FolderView } from "./folder.js";
import { MatchView, MergeView } from "./merge.js";

const place = document.getElementById("view"), crumbs = document.getElementById("crumbs");
let view = null;

function route() {
  view?.close();
  const [, kind = "", ...rest] = location.hash.split("/"), path = rest.map(decodeURIComponent).join("/");
  place.className = `view-${kind || "folder"}`;
  for (const name of Object.keys(place.dataset)) delete place.dataset[name];
  place.replaceChildren();
  const names = { map: path, merge: path, match: rest.map(decodeURIComponent).join(" and ") };
  crumbs.replaceChildren(...(names[kind] ? [el("span", {}, names[kind])] : []));
  if (names[kind]) document.title = `${names[kind]} – topomerge studio`;
  if (kind === "map") view = new Editor(place, path);
  else if (kind === "merge") view = new MergeView(place, path);
  else if (kind === "match" && rest.length === 2) view = new MatchView(place, rest.map(decodeURIComponent));
  else view = new FolderView(place);
  window.studio = view; // for those who look for a fault, and for tests
}

const name = el("input", { type: "text", size: 12, maxLength: 64, placeholder: "your name", ariaLabel: "Your name, in the journal", value: localStorage.getItem("topomerge-name") || "", onchange: (event) => localStorage.setItem("topomerge-name", event.target.value.trim()) });
document.querySelector(".bar").append(name);
window.addEventListener("hashchange", route);
listen((on) => { document.getElementById("link").textContent = on ? "" : "The studio does not answer; is it still running?"; });
route();
