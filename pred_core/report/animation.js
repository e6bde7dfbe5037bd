"use strict";
// Orthographic view turned by dragging; coordinates arrive as tenths of a millimetre around the centre of the scene.
function run(host, data) {
  const canvas = document.createElement("canvas"), bar = document.createElement("div");
  const play = document.createElement("button"), slider = document.createElement("input");
  const clock = document.createElement("span"), frames = data.tracks[0].frames.length;
  const ratio = window.devicePixelRatio || 1, width = 860, height = 440;
  canvas.width = width * ratio; canvas.height = height * ratio;
  canvas.style.cssText = "width:" + width + "px;max-width:100%;border:1px solid #d0d7de;cursor:grab;touch-action:none";
  slider.type = "range"; slider.min = 0; slider.max = frames - 1; slider.value = 0; slider.style.width = "340px";
  play.textContent = "Play"; bar.style.cssText = "display:flex;gap:1em;align-items:center;flex-wrap:wrap;margin:.4em 0";
  bar.append(play, slider, clock);
  const shown = data.tracks.map(() => true);
  data.tracks.forEach((track, i) => {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = true;
    box.onchange = () => { shown[i] = box.checked; draw(); };
    label.style.color = track.color; label.append(box, " " + track.name); bar.append(label);
  });
  const caption = document.createElement("figcaption");
  caption.textContent = data.title + " Drag to turn. The bar is 10 cm.";
  host.append(canvas, bar, caption);
  let azimuth = 0.6, elevation = 0.3, timer = null;
  const context = canvas.getContext("2d"), scale = 0.46 * height / (data.size * 10000);
  function project(frame, k) {
    const x = frame[3 * k], y = frame[3 * k + 1], z = frame[3 * k + 2];
    if (x === null || y === null || z === null) return null;
    const right = x * Math.cos(azimuth) + y * Math.sin(azimuth);
    const depth = -x * Math.sin(azimuth) + y * Math.cos(azimuth);
    const up = z * Math.cos(elevation) + depth * Math.sin(elevation);
    return [width / 2 + scale * right, height / 2 - scale * up];
  }
  function draw() {
    const t = Number(slider.value);
    clock.textContent = (t * data.step).toFixed(2) + " s";
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = "#fff"; context.fillRect(0, 0, width, height);
    context.strokeStyle = "#57606a"; context.lineWidth = 2;
    context.beginPath(); context.moveTo(20, height - 20); context.lineTo(20 + scale * 1000, height - 20); context.stroke();
    data.tracks.forEach((track, i) => {
      if (!shown[i]) return;
      const frame = track.frames[t], points = [];
      for (let k = 0; k < frame.length / 3; ++k) points.push(project(frame, k));
      context.strokeStyle = context.fillStyle = track.color; context.lineWidth = i === 0 ? 4 : 2;
      if (data.line) {
        let pen = false; context.beginPath();
        points.forEach(p => { if (!p) { pen = false; return; } if (pen) context.lineTo(p[0], p[1]); else context.moveTo(p[0], p[1]); pen = true; });
        context.globalAlpha = i === 0 ? 0.45 : 1; context.stroke(); context.globalAlpha = 1;
      }
      points.forEach(p => { if (p) { context.beginPath(); context.arc(p[0], p[1], i === 0 ? 4 : 2.5, 0, 7); context.fill(); } });
    });
  }
  function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; }
  play.onclick = () => {
    if (timer) { stop(); return; }
    if (Number(slider.value) >= frames - 1) slider.value = 0;
    play.textContent = "Pause";
    timer = setInterval(() => {
      if (Number(slider.value) >= frames - 1) { stop(); return; }
      slider.value = Number(slider.value) + 1; draw();
    }, 1000 * data.step);
  };
  slider.oninput = draw;
  canvas.onpointerdown = e => { canvas.setPointerCapture(e.pointerId); canvas.style.cursor = "grabbing"; };
  canvas.onpointerup = () => { canvas.style.cursor = "grab"; };
  canvas.onpointermove = e => {
    if (!e.buttons) return;
    azimuth += 0.01 * e.movementX;
    elevation = Math.max(-1.57, Math.min(1.57, elevation + 0.01 * e.movementY));
    draw();
  };
  draw();
}
