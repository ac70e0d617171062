// The 3D view of the report page: an avatar.glb with its animation, skeleton and wireframe.
// `viewer.min.js` beside this file is this source bundled with three.js; README.md says how to rebuild it.
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

const ACCENT = 0x2f7df6;
const CLAY = new THREE.MeshStandardMaterial({ color: 0xb9b4ae, roughness: 0.85, metalness: 0 });
const WIRE = new THREE.MeshBasicMaterial({ color: ACCENT, wireframe: true, transparent: true, opacity: 0.35 });

/** Bytes of a base64 string: `fetch` of a data URI is refused by some browsers on file:// pages. */
function decodeBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
  return bytes.buffer;
}

function button(label, title, onPress, pressed = null) {
  const element = document.createElement("button");
  element.type = "button";
  element.textContent = label;
  element.title = title;
  if (pressed !== null) element.setAttribute("aria-pressed", String(pressed));
  element.addEventListener("click", () => onPress(element));
  return element;
}

/** A button that stays pressed; `onChange(isOn)` runs on every change and once at the start. */
function toggle(label, title, isOn, onChange) {
  onChange(isOn);
  return button(label, title, (element) => {
    const next = element.getAttribute("aria-pressed") !== "true";
    element.setAttribute("aria-pressed", String(next));
    onChange(next);
  }, isOn);
}

function makeStage() {
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight(0xffffff, 0xa8a29a, 2.3));
  const key = new THREE.DirectionalLight(0xffffff, 1.3);
  key.castShadow = true;
  key.shadow.mapSize.set(1024, 1024);
  key.shadow.radius = 6;
  key.shadow.bias = -0.002;
  Object.assign(key.shadow.camera, { left: -1.4, right: 1.4, top: 1.4, bottom: -1.4, near: 0.1, far: 8 });
  scene.add(key, key.target);
  const floor = new THREE.Group();
  const shadow = new THREE.Mesh(new THREE.CircleGeometry(4, 64), new THREE.ShadowMaterial({ opacity: 0.22 }));
  shadow.rotation.x = -Math.PI / 2;
  shadow.receiveShadow = true;
  const grid = new THREE.PolarGridHelper(1.5, 12, 6, 96, 0x8a8f98, 0x8a8f98);
  grid.material.transparent = true;
  grid.material.opacity = 0.28;
  floor.add(shadow, grid);
  scene.add(floor);
  return { scene, key, floor };
}

/** World-space box of all skinned vertices in the pose that the skeleton holds now. */
function posedBox(model, meshes) {
  const box = new THREE.Box3();
  model.updateMatrixWorld(true);
  for (const mesh of meshes) {
    mesh.skeleton.update();
    mesh.computeBoundingBox();
    box.union(mesh.boundingBox.clone().applyMatrix4(mesh.matrixWorld));
  }
  return box;
}

class AvatarView {
  constructor(root, gltf) {
    this.root = root;
    this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.VSMShadowMap;
    Object.assign(this, makeStage());
    this.camera = new THREE.PerspectiveCamera(28, 1, 0.05, 60);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.enableDamping = true;
    this.controls.minDistance = 0.3;
    this.controls.maxDistance = 12;
    this.adopt(gltf);
    root.append(this.renderer.domElement);
    new ResizeObserver(() => this.resize()).observe(root);
    this.resize();
    this.setMotion(this.clip !== undefined);
  }

  adopt(gltf) {
    this.model = gltf.scene;
    this.meshes = [];
    this.model.traverse((node) => { if (node.isSkinnedMesh) this.meshes.push(node); });
    if (this.meshes.length === 0) throw new Error("the file holds no skinned mesh");
    this.scene.add(this.model);
    this.wires = this.meshes.map((mesh) => {
      mesh.castShadow = true;
      mesh.frustumCulled = false;
      mesh.userData.textured = mesh.material;
      const wire = new THREE.SkinnedMesh(mesh.geometry, WIRE);
      wire.frustumCulled = false;
      wire.bind(mesh.skeleton, mesh.bindMatrix);
      mesh.add(wire);
      return wire;
    });
    this.hips = this.meshes[0].skeleton.bones[0];
    this.bones = new THREE.SkeletonHelper(this.hips);
    Object.assign(this.bones.material, { depthTest: false, transparent: true, linewidth: 2, vertexColors: false });
    this.bones.material.color.set(ACCENT);
    this.scene.add(this.bones);
    this.clip = gltf.animations[0];
    this.mixer = new THREE.AnimationMixer(this.model);
    this.action = this.clip && this.mixer.clipAction(this.clip);
    this.playing = true;
    this.speed = 1;
  }

  get duration() { return this.clip ? this.clip.duration : 0; }
  get time() { return this.action ? this.action.time : 0; }

  seek(time_s) {
    if (!this.action || !this.moving) return;
    this.action.time = time_s;
    this.mixer.update(0);
  }

  /** True plays the video's motion, false holds the bind pose (the canonical A-pose). */
  setMotion(moving) {
    this.moving = moving && Boolean(this.action);
    this.mixer.stopAllAction();
    if (this.moving) this.action.reset().play();
    else this.meshes.forEach((mesh) => mesh.skeleton.pose());
    this.mixer.update(0);
    this.frame();
  }

  /** Puts the floor under the lowest point of the motion and the camera in front of the person. */
  frame() {
    const lowest = [0, 0.25, 0.5, 0.75].map((part) => {
      this.seek(part * this.duration);
      return posedBox(this.model, this.meshes).min.y;
    });
    this.seek(0);
    const box = posedBox(this.model, this.meshes);
    const size = box.getSize(new THREE.Vector3());
    const centre = box.getCenter(new THREE.Vector3());
    this.floor.position.set(centre.x, Math.min(...lowest), centre.z);
    const half = THREE.MathUtils.degToRad(this.camera.fov / 2);
    const distance = (0.6 * Math.max(size.y, size.x / this.camera.aspect)) / Math.tan(half) + size.z / 2;
    centre.y -= 0.05 * size.y; // leaves room for the buttons under the feet
    this.controls.target.copy(centre);
    this.camera.position.set(centre.x, centre.y + 0.12 * distance, centre.z + distance);
    this.anchor = this.hips.getWorldPosition(new THREE.Vector3());
    this.follow();
  }

  /** Moves camera, light and floor with the hips, so that a walking person stays in the picture. */
  follow() {
    const now = this.hips.getWorldPosition(new THREE.Vector3());
    const step = now.clone().sub(this.anchor).setY(0);
    this.camera.position.add(step);
    this.controls.target.add(step);
    this.floor.position.add(step);
    this.key.target.position.copy(now);
    this.key.position.copy(now).add(new THREE.Vector3(1.3, 2.6, 2.2));
    this.anchor.copy(now);
  }

  setTextured(isOn) {
    for (const mesh of this.meshes) mesh.material = isOn ? mesh.userData.textured : CLAY;
  }

  resize() {
    const { clientWidth, clientHeight } = this.root;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.camera.updateProjectionMatrix();
  }

  step(delta_s) {
    if (this.playing && this.moving) this.mixer.update(delta_s * this.speed);
    this.follow();
    this.controls.update(delta_s);
    this.renderer.render(this.scene, this.camera);
  }
}

function toolbar(view) {
  const bar = document.createElement("div");
  bar.className = "viewer-bar";
  const play = button("Pause", "Play or pause the video's motion (space)", () => {
    view.playing = !view.playing;
    play.textContent = view.playing ? "Pause" : "Play";
  });
  const scrub = document.createElement("input");
  Object.assign(scrub, { type: "range", min: 0, max: view.duration, step: "any", value: 0, title: "Time" });
  scrub.setAttribute("aria-label", "Time in the video's motion");
  scrub.addEventListener("input", () => {
    view.playing = false;
    play.textContent = "Play";
    view.seek(Number(scrub.value));
  });
  const motion = [play, scrub];
  const aPose = toggle("A-pose", "Hold the bind pose", false, (isOn) => {
    view.setMotion(!isOn);
    motion.forEach((element) => { element.disabled = isOn; });
  });
  const views = [
    toggle("Skeleton", "Show the bones", false, (isOn) => { view.bones.visible = isOn; }),
    toggle("Wireframe", "Show the triangles", false, (isOn) => { view.wires.forEach((w) => { w.visible = isOn; }); }),
    toggle("Texture", "Texture or plain clay", true, (isOn) => view.setTextured(isOn)),
    toggle("Turn", "Turn by itself", false, (isOn) => { view.controls.autoRotate = isOn; }),
    button("Reset", "Back to the first view", () => view.frame()),
  ];
  bar.append(...(view.duration > 0 ? [...motion, aPose] : []), ...views);
  view.root.addEventListener("keydown", (event) => {
    if (event.code !== "Space" || event.target.tagName === "BUTTON") return;
    event.preventDefault();
    play.click();
  });
  return { bar, scrub };
}

/** Shows the base64 GLB `text` inside the element `root`; resolves with the view, rejects with a reason. */
export async function mount(root, text) {
  const gltf = await new GLTFLoader().parseAsync(decodeBase64(text), "");
  root.replaceChildren();
  const view = new AvatarView(root, gltf);
  const { bar, scrub } = toolbar(view);
  root.append(bar);
  let onScreen = true;
  new IntersectionObserver(([entry]) => { onScreen = entry.isIntersecting; }).observe(root);
  const clock = new THREE.Clock();
  view.renderer.setAnimationLoop(() => {
    const delta_s = Math.min(clock.getDelta(), 0.1);
    if (!onScreen) return;
    view.step(delta_s);
    if (view.playing && view.moving) scrub.value = String(view.time);
  });
  root.dataset.ready = "true";
  return view;
}
