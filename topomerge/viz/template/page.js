// What happens when the page is opened.

function startTheme(button) {
  const root = document.documentElement;
  const system = window.matchMedia("(prefers-color-scheme: dark)");
  const dark = () => (root.dataset.theme ? root.dataset.theme === "dark" : system.matches);
  const tell = () => {
    button.textContent = dark() ? "Light" : "Dark";
    button.title = dark() ? "Show on white" : "Show on black";
    document.dispatchEvent(new CustomEvent("theme"));
  };
  button.addEventListener("click", () => { root.dataset.theme = dark() ? "light" : "dark"; tell(); });
  system.addEventListener("change", tell);
  button.hidden = false;
  tell();
}

startTheme(document.getElementById("theme"));
startHighlights();
document.querySelectorAll("table.sortable").forEach(startTable);
document.querySelectorAll("input[data-find]").forEach(startFind);
document.querySelectorAll(".plan-view").forEach(startPlan);
document.querySelectorAll("input[data-blend]").forEach(startBlend);
document.querySelectorAll("input[data-bend]").forEach(startBend);
document.querySelectorAll(".diff-view").forEach(startDiff);
startMates(document.getElementById("mates"));
startPlaces(document.getElementById("places"));
startStamp(document.getElementById("stamp"));
// The page is shown before the cells are read; that there is no 3D is said only once it is known.
document.querySelectorAll("[data-scene]").forEach((place) => place.classList.add("waiting"));
setTimeout(() => document.querySelectorAll("[data-scene]").forEach((place) => openScene(place)), 50);
