// The page's own behaviour: starts the 3D view, and the wipe that compares a held-out frame with its renders.
(() => {
  const root = document.getElementById("viewer");
  const texts = (selector) => [...document.querySelectorAll(selector)].map((part) => part.textContent);
  const [glb] = texts("#avatar-glb");
  const [coverage = null] = texts("#avatar-coverage");
  AvatarViewer.mount(root, { glb, coverage, levels: texts(".avatar-level") }).then(
    (view) => { window.avatarView = view; },
    (error) => {
      root.innerHTML = '<p class="viewer-note"></p>';
      root.firstChild.textContent = `The 3D view cannot be shown here: ${error.message}. Open export/avatar.glb instead.`;
    },
  );

  const rows = [...document.querySelectorAll(".frame")];
  const wipe = document.getElementById("wipe");
  if (rows.length === 0) return;
  wipe.hidden = false;
  wipe.innerHTML = `
    <div class="wipe-controls"><select aria-label="Frame"></select><select aria-label="Render">
      <option value="mesh">mesh</option><option value="field">field</option></select></div>
    <div class="wipe-stage"><img class="under" alt="video frame"><img class="over" alt="render"><i></i>
      <em>video</em><em></em></div>
    <input type="range" min="0" max="100" value="50" aria-label="Wipe between video and render">`;
  const [frame, kind] = wipe.querySelectorAll("select");
  const [under, over] = wipe.querySelectorAll("img");
  const [, name] = wipe.querySelectorAll("em");
  const stage = wipe.querySelector(".wipe-stage");
  const slider = wipe.querySelector("input");
  rows.forEach((row, i) => frame.add(new Option(`frame ${row.dataset.frame}`, i)));

  const show = () => {
    const row = rows[frame.value];
    under.src = row.querySelector('[data-kind="video"]').src;
    over.src = row.querySelector(`[data-kind="${kind.value}"]`).src;
    name.textContent = kind.value;
  };
  const cut = (percent) => {
    slider.value = percent;
    stage.style.setProperty("--cut", `${slider.value}%`);
  };
  const point = (event) => {
    const box = stage.getBoundingClientRect();
    cut((100 * (event.clientX - box.left)) / box.width);
  };
  frame.addEventListener("change", show);
  kind.addEventListener("change", show);
  slider.addEventListener("input", () => cut(slider.value));
  stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); point(event); });
  stage.addEventListener("pointermove", (event) => { if (event.buttons) point(event); });
  show();
})();
