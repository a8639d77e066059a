"use strict";

// A click on a room of the plan of what each room says opens the pictures of its places.
function startPlaces(section) {
  if (!section) {
    return;
  }
  section.addEventListener("click", (event) => {
    const room = event.target.closest ? event.target.closest(".plan-view [data-room]") : null;
    if (!room) {
      return;
    }
    const number = room.dataset.room.replace(/^a/, "");
    for (const details of section.querySelectorAll("details[data-room-of-a]")) {
      details.open = details.dataset.roomOfA === number;
      if (details.open) {
        details.scrollIntoView({ block: "nearest" });
      }
    }
  });
}
