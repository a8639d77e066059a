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

function startBend(slider) { // an outline has as many numbers rigid as bent, and each goes from the one to the other
  const view = slider.closest(".plan-view"), number = /-?\d+/g;
  let parts = null;
  const read = (path) => {
    const bent = path.getAttribute("d"), rigid = path.dataset.rigid;
    return { path, words: bent.split(number), from: (rigid.match(number) || []).map(Number), to: (bent.match(number) || []).map(Number) };
  };
  slider.addEventListener("input", () => {
    parts = parts || [...view.querySelectorAll("[data-rigid]")].map(read);
    const share = Number(slider.value);
    for (const { path, words, from, to } of parts) {
      path.setAttribute("d", words.map((word, i) => (i < to.length ? word + Math.round(10 * (from[i] + share * (to[i] - from[i]))) / 10 : word)).join(""));
    }
  });
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
