// What has changed: a swipe between the old map and the new one, and switches of the kinds of changes.

function startDiff(view) {
  const slider = view.querySelector("input[data-swipe]"), far = 1e7;
  const drawings = [...view.querySelectorAll("svg.plan")];
  const make = (name, parent, attributes) => {
    const element = document.createElementNS(parent.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    return parent.appendChild(element);
  };
  const sides = drawings.map((svg, i) => {
    const clips = ["a", "b"].map((side) => {
      const id = `swipe-${i}-${side}`, clip = make("clipPath", svg.querySelector("defs"), { id, clipPathUnits: "userSpaceOnUse" });
      for (const part of svg.querySelectorAll(`.side-${side}`)) part.dataset.clip = `url(#${id})`;
      return make("rect", clip, { x: -far, y: -far, width: 2 * far, height: 2 * far });
    });
    return { svg, clips, line: make("path", svg, { class: "swipe", d: "" }) };
  });
  const set = () => { // in the middle of the way neither is cut off only at the ends of the slider
    for (const { svg, clips, line } of sides) {
      const [x, y, wide, tall] = svg.getAttribute("viewBox").split(" ").map(Number), at = x + Number(slider.value) * wide;
      clips[0].setAttribute("width", at + far);
      clips[1].setAttribute("x", at);
      line.setAttribute("d", `M${at} ${y - tall}V${y + 2 * tall}`);
      for (const part of svg.querySelectorAll("[data-clip]")) part.setAttribute("clip-path", part.dataset.clip);
    }
  };
  slider.addEventListener("input", set);
  for (const box of view.querySelectorAll(".diff-layers input")) {
    box.addEventListener("change", () => view.classList.toggle("hide-" + box.dataset.layer, !box.checked));
  }
}
