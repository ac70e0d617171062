// Buttons, lists and sliders of the 3D view. Every control works by mouse, touch and keyboard.
import { headsetButton } from "./headset.js";

const SURFACE_NAMES = {
  lit: ["Texture", "Texture under a neutral light"],
  unlit: ["Texture, unlit", "Texture as it is, with the light of the video only"],
  clay: ["Clay", "Shape without colours"],
  coverage: ["Coverage", "What the video shows, on the finest level"],
};

function element(tag, attributes = {}, ...children) {
  const node = Object.assign(document.createElement(tag), attributes);
  node.append(...children);
  return node;
}

function button(label, title, onPress) {
  const node = element("button", { type: "button", textContent: label, title });
  node.addEventListener("click", () => onPress(node));
  return node;
}

/** A button that stays pressed; `onChange(isOn)` runs on every change. */
function toggle(label, title, isOn, onChange) {
  const node = button(label, title, () => {
    const next = node.getAttribute("aria-pressed") !== "true";
    node.setAttribute("aria-pressed", String(next));
    onChange(next);
  });
  node.setAttribute("aria-pressed", String(isOn));
  return node;
}

/** A list of [text, value]; `onChange(value)` gets the chosen value as a string. */
function choice(label, options, onChange) {
  const node = element("select", { title: label, ariaLabel: label });
  options.forEach(([text, value, title]) => node.append(element("option", { textContent: text, value, title: title ?? "" })));
  node.addEventListener("change", () => onChange(node.value));
  return node;
}

function slider(label, max, onInput) {
  const node = element("input", { type: "range", min: 0, max, step: "any", ariaLabel: label, title: label });
  node.value = 0;
  node.addEventListener("input", () => onInput(Number(node.value)));
  return node;
}

class Player {
  constructor(view) {
    this.view = view;
    this.play = button("", "Play or pause (space)", () => this.setPlaying(!view.playing));
    this.scrub = slider("Time in the clip", view.avatar.duration, (time_s) => {
      this.setPlaying(false);
      view.avatar.seek(time_s);
    });
    this.clock = element("output", { className: "viewer-time" });
    const clips = view.avatar.clips.map(({ name }, index) => [name || `clip ${index + 1}`, index]);
    this.clip = choice("Clip", [...clips, ["rest pose", -1]], (index) => this.setClip(Number(index)));
    this.setClip(view.avatar.clipIndex);
    this.setPlaying(view.playing);
  }

  get elements() { return this.view.avatar.clips.length > 0 ? [this.play, this.clip, this.scrub, this.clock] : []; }

  setPlaying(isOn) {
    this.view.playing = isOn;
    this.play.textContent = isOn ? "Pause" : "Play";
  }

  setClip(index) {
    const { avatar } = this.view;
    if (index !== avatar.clipIndex) {
      avatar.setClip(index);
      this.view.frame();
    }
    this.clip.value = String(index);
    this.scrub.max = String(avatar.duration);
    this.play.disabled = this.scrub.disabled = avatar.duration === 0;
    this.show();
  }

  show() {
    const { time, duration } = this.view.avatar;
    this.scrub.value = String(time);
    this.clock.textContent = duration > 0 ? `${time.toFixed(1)} / ${duration.toFixed(1)} s` : "";
  }
}

function morphPanel(avatar) {
  const names = [...avatar.morphs.keys()];
  const sliders = names.map((name) => slider(name, 1, (weight) => avatar.setMorph(name, weight)));
  sliders.forEach((input, index) => { input.value = String(avatar.morphWeight(names[index])); });
  const rows = sliders.map((input, index) => element("label", {}, element("span", { textContent: names[index] }), input));
  const reset = button("Reset all", "All morph targets to 0", () => {
    names.forEach((name, index) => { avatar.setMorph(name, 0); sliders[index].value = "0"; });
  });
  const summary = element("summary", { textContent: `Morph targets (${names.length})` });
  return element("details", { className: "viewer-morphs" }, summary, element("div", {}, reset, ...rows));
}

/** Adds all controls to `root`; returns the player, whose `show` is called once a frame. */
export async function addControls(root, view) {
  const { avatar } = view;
  const player = new Player(view);
  const surfaces = avatar.surfaces.map((name) => [SURFACE_NAMES[name][0], name, SURFACE_NAMES[name][1]]);
  const legend = element("p", { className: "viewer-legend", hidden: true });
  legend.append("filled in", element("i"), "seen well");
  const surface = choice("Surface", surfaces, (name) => {
    avatar.setSurface(name);
    legend.hidden = name !== "coverage";
  });
  const details = avatar.triangles.map((count, index) => [`${count.toLocaleString("en")} triangles`, index]);
  const controls = [
    surface,
    ...(details.length > 1 ? [choice("Level of detail", details, (level) => avatar.setLevel(Number(level)))] : []),
    toggle("Wireframe", "Show the triangles", false, (isOn) => avatar.setWireframe(isOn)),
    toggle("Skeleton", "Show the bones", false, (isOn) => avatar.setSkeleton(isOn)),
    toggle("Turn", "Turn by itself", false, (isOn) => { view.controls.autoRotate = isOn; }),
    button("Reset view", "Back to the first view (Home)", () => view.frame()),
  ];
  const headset = await headsetButton(view, button, () => player.setPlaying(!view.playing));
  const time = element("div", { className: "viewer-bar" }, ...player.elements);
  const bar = element("div", { className: "viewer-bar" }, ...controls, ...(headset ? [headset] : []));
  if (avatar.morphs.size > 0) view.root.append(morphPanel(avatar));
  view.root.append(legend);
  root.append(time, bar);
  root.addEventListener("keydown", (event) => {
    if (event.target !== root || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === "Space") player.setPlaying(!view.playing);
    else if (!view.press(event.key)) return;
    event.preventDefault();
  });
  return player;
}
