// The eye on a part: fingers, mouse and arrow keys turn it, the wheel brings it closer, a click means a place.
"use strict";

// `box` is what has to be in the picture, `from` where the eye was; `moved` is called after every move, `clicked` with a click.
function partEye(canvas, box, from, moved, clicked) {
  let { yaw, pitch, zoom, panX, panY } = from || { yaw: 0, pitch: 0, zoom: 1, panX: 0, panY: 0 };
  const fingers = new Map();
  let pressed = null;
  canvas.addEventListener("pointerdown", e => {
    fingers.set(e.pointerId, e); canvas.setPointerCapture(e.pointerId);
    pressed = fingers.size === 1 ? e : null;
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, e => {
    fingers.delete(e.pointerId);
    const still = pressed && Math.hypot(e.clientX - pressed.clientX, e.clientY - pressed.clientY) < 4;
    if (still && name === "pointerup" && e.button === 0) clicked(e);
    pressed = null;
  });
  canvas.addEventListener("pointermove", e => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const x = (e.clientX - before.clientX) / canvas.clientWidth, y = (e.clientY - before.clientY) / canvas.clientHeight;
    if (fingers.size > 1) {
      const other = [...fingers.values()].find(f => f.pointerId !== e.pointerId);
      const far = f => Math.hypot(f.clientX - other.clientX, f.clientY - other.clientY);
      zoom = Math.min(12, Math.max(0.5, zoom * far(e) / Math.max(far(before), 1)));
      panX += x; panY -= y;
    } else if (e.shiftKey || e.buttons === 4 || e.buttons === 2) { panX += 2 * x; panY -= 2 * y; }
    else { yaw += 4 * x; pitch = Math.min(1.6, Math.max(-1.6, pitch + 3 * y)); }
    fingers.set(e.pointerId, e); moved();
  });
  canvas.addEventListener("contextmenu", e => e.preventDefault());
  canvas.addEventListener("wheel", e => {
    if (document.activeElement !== canvas && !e.ctrlKey) return;  // the page scrolls until the part is clicked
    e.preventDefault(); zoom = Math.min(12, Math.max(0.5, zoom * Math.exp(-e.deltaY / 500))); moved();
  }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const step = 0.12;
    if (e.key === "ArrowLeft") yaw -= step; else if (e.key === "ArrowRight") yaw += step;
    else if (e.key === "ArrowUp") pitch -= step; else if (e.key === "ArrowDown") pitch += step;
    else if (e.key === "+") zoom *= 1.15; else if (e.key === "-") zoom /= 1.15;
    else if (e.key === "Home") { yaw = pitch = panX = panY = 0; zoom = 1; } else return;
    e.preventDefault(); moved();
  });
  const turn = () => {
    const a = Math.cos(yaw), b = Math.sin(yaw), c = Math.cos(pitch), d = Math.sin(pitch);
    return [a, b * d, -b * c, 0, c, d, b, -a * d, a * c];
  };
  function scales() {
    const w = canvas.clientWidth, h = canvas.clientHeight, fit = Math.min(w / box[0], h / box[1]);
    return [1.9 * zoom * fit / w, 1.9 * zoom * fit / h];
  }
  return {
    turn,  // 3 × 3, columns one after the other
    scales,
    shift: () => [panX, panY],
    now: () => ({ yaw, pitch, zoom, panX, panY }),
    set(eye) { ({ yaw, pitch, zoom, panX, panY } = eye); },
  };
}

// The vertex nearest to the eye within a few pixels of a click tells which place was meant; -1 where there is none.
function nearestVertex({ vertices, count }, canvas, look, e) {
  const box = canvas.getBoundingClientRect(), m = look.turn(), [sx, sy] = look.scales(), [panX, panY] = look.shift();
  const x = 2 * (e.clientX - box.left) / box.width - 1, y = 1 - 2 * (e.clientY - box.top) / box.height;
  const near2 = (14 / Math.min(box.width, box.height)) ** 2;
  let best = -1, depth = -Infinity;
  for (let i = 0; i < count; i++) {
    const [p, q, r] = [0, 1, 2].map(k => vertices[3 * i + k] / 32767);
    const u = (m[0] * p + m[3] * q + m[6] * r) * sx + panX - x, v = (m[1] * p + m[4] * q + m[7] * r) * sy + panY - y;
    const z = m[2] * p + m[5] * q + m[8] * r;
    if (u * u + v * v < near2 && z > depth) { best = i; depth = z; }
  }
  return best;
}
