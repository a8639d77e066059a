"use strict";

// A click on a room of a plan opens the pictures of its places: of room a3 those of room 3 of a.
function startPlaces(section) {
  if (!section) {
    return;
  }
  section.addEventListener("click", (event) => {
    const room = event.target.closest ? event.target.closest(".plan-view [data-room]") : null;
    if (!room) {
      return;
    }
    const [map, number] = [room.dataset.room[0], room.dataset.room.slice(1)];
    for (const details of section.querySelectorAll("details[data-room-of-a]")) {
      details.open = (map === "b" ? details.dataset.roomOfB : details.dataset.roomOfA) === number;
      if (details.open) {
        details.scrollIntoView({ block: "nearest" });
      }
    }
  });
}
