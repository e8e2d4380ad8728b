// Clicks and drags in the camera's picture, with mouse, pen or finger. Places are from 0 to 1 of the picture.
const DRAG = 0.03;
let begin = null;

function place(event) {
  const box = element.querySelector("img").getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

element.addEventListener("pointerdown", (event) => {
  if (!event.target.closest(".picture") || event.button !== 0) return;
  begin = place(event);
  element.setPointerCapture(event.pointerId);
});

element.addEventListener("pointerup", (event) => {
  if (begin === null) return;
  const to = place(event);
  const dragged = Math.hypot(to[0] - begin[0], to[1] - begin[1]) > DRAG;
  trigger(dragged ? "release" : "click", { begin, to });
  begin = null;
});

element.addEventListener("pointercancel", () => { begin = null; });
