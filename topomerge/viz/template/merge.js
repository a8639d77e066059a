// Reports of merges: one map's plan over the other's, and rooms that are one light up together.

function startBlend(slider) {
  const view = slider.closest(".plan-view"), share = () => Number(slider.value);
  const set = () => { // in the middle both are whole, at either end one is alone
    for (const part of view.querySelectorAll(".of-a")) part.style.opacity = Math.min(2 - 2 * share(), 1);
    for (const part of view.querySelectorAll(".of-b")) part.style.opacity = Math.min(2 * share(), 1);
  };
  slider.addEventListener("input", set);
  set();
}

function startMates(data) {
  if (!data) return;
  const mates = JSON.parse(data.textContent);
  let shown = [];
  document.addEventListener("lit", (event) => {
    for (const element of shown) element.classList.remove("mate");
    const room = event.detail && event.detail.startsWith("room ") ? event.detail.slice(5) : null;
    shown = ((room && mates[room]) || []).flatMap((one) => places.get("room " + one) || []);
    for (const element of shown) element.classList.add("mate");
  });
}
