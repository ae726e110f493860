// The map of the built-in room: it grows frame by frame, forgets, and is mended by revisits.
async function start(section) {
  const { camera, frames, poses, above, moments, psnr, own, revisited } = DATA;
  const maps = await storedMaps(DATA.map), photo = await photograph(DATA.photos);
  const last = moments.length - 1, online = moments.filter(({ pass }) => pass === 0).length - 1;
  const words = { moment: (k) => (k <= online ? `${moments[k].frames} frames` : `+ ${moments[k].pass} passes`), frame: (k) => String(frames[k]) };
  const panel = openPanel(section, { draw, words });
  const view = panel.picture("view", camera), seen = panel.picture("photo", camera), chart = panel.chart("psnr");
  const { moment, play } = panel.inputs, clock = { timer: 0, played: false };

  function stop() {
    clearInterval(clock.timer);
    clock.timer = 0;
    play.textContent = "Play";
  }
  play.addEventListener("click", () => {
    if (clock.timer) return stop();
    if (!clock.played || Number(moment.value) >= last) moment.value = 0;
    clock.played = true;
    play.textContent = "Pause";
    clock.timer = setInterval(() => {
      moment.value = Number(moment.value) + 1;
      panel.redraw();
      if (Number(moment.value) >= last) stop();
    }, 700);
    return undefined;
  });
  whileSeen(section, (isSeen) => isSeen || stop());

  /** Without what is nearer than `cut` metres: it opens the room from above. */
  function drawFrom(map, { pose, cut }) {
    const splats = projectGaussians(map, camera, viewOf(pose));
    for (let i = 0; i < map.n; i++) if (splats.depth_m[i] < cut) splats.visible[i] = 0;
    drawPixels(view, composite(splats, camera).rgb, camera, true);
  }

  function drawChart(k, mapped, chosen) {
    const dots = (X, Y) => frames.slice(0, mapped).map((frame, i) =>
      `<circle cx="${X(i)}" cy="${Y(psnr[k][i])}" r="${i === chosen ? 6 : 3}" class="${i === chosen ? "gsnb-live-chosen" : "gsnb-live-dot"}"><title>frame ${frame}: ${psnr[k][i].toFixed(1)} dB</title></circle>`).join("");
    const line = (values, style) => ({ points: values.slice(0, mapped).map((dB, i) => [i, dB]), style });
    const lines = [line(own, 'stroke-dasharray="2 4"')];
    if (k >= online) lines.push(line(revisited, 'stroke-dasharray="9 4" opacity="0.6"'));
    chart.innerHTML = graph("PSNR of every mapped frame", ["frame, in the order of mapping", 0, frames.length - 1], ["PSNR, dB", 8, 26], lines, dots);
  }

  function draw({ moment: k, frame, from }) {
    const { frames: mapped, pass } = moments[k], map = maps[k], chosen = Math.min(frame, mapped - 1);
    drawFrom(map, from === "above" ? above : { pose: poses[chosen], cut: 0 });
    const across = photo.naturalWidth / camera.width;
    seen.drawImage(photo, (chosen % across) * camera.width, Math.floor(chosen / across) * camera.height, camera.width, camera.height, 0, 0, camera.width, camera.height);
    drawChart(k, mapped, chosen);
    const mean = psnr[k].slice(0, mapped).reduce((a, b) => a + b, 0) / mapped;
    const what = pass ? `after ${pass} passes over the keyframes` : `after ${mapped} frames`;
    return `<b>${map.n.toLocaleString("en")} Gaussians</b> ${what}. Frame ${frames[chosen]}: ${own[chosen].toFixed(1)} dB when it was mapped,
      <b>${psnr[k][chosen].toFixed(1)} dB now</b>. All mapped frames: ${mean.toFixed(1)} dB on average.`;
  }
}
