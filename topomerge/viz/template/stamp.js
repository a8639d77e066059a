// The page loads itself anew when a newer one lies in its place: a style sheet beside it names that one's stamp.
// A style sheet, as pages that are opened from the disk may read no other file, and as it can do no harm.

const STAMP_EVERY = 2000; // ms

function startStamp(mark) {
  if (!mark) return;
  let number = 0;
  const look = () => {
    const sheet = document.createElement("link");
    sheet.rel = "stylesheet";
    sheet.onload = () => {
      const held = (name) => getComputedStyle(mark).getPropertyValue(`--${name}`).trim().replaceAll('"', "");
      const [stamp, whole] = [held(mark.dataset.name), held("stamp")];
      sheet.remove();
      if (stamp && stamp !== mark.dataset.stamp) location.reload();
      else if (whole && !stamp) location.replace("report.html"); // this joined map has no page any more
      else setTimeout(look, STAMP_EVERY);
    };
    sheet.onerror = () => {
      sheet.remove();
      if (number > 1) setTimeout(look, STAMP_EVERY); // it was there before: the page is just being written
    };
    sheet.href = `report_stamp.css?${++number}-${Date.now()}`;
    document.head.append(sheet);
  };
  setTimeout(look, STAMP_EVERY);
}
