// Scene, lights, floor and camera of the 3D view.
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const KEY_TURN_RAD = 0.12;
const KEY_ZOOM = 1.1;
const ROOM_AROUND = 1.16; // height of the picture in heights of the person

function makeScene() {
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

export class AvatarView {
  /** root: element that the picture fills. The floor of the file is at y = 0. */
  constructor(root, avatar) {
    this.root = root;
    this.avatar = avatar;
    this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.VSMShadowMap;
    Object.assign(this, makeScene());
    this.scene.add(avatar.model, avatar.bones);
    this.camera = new THREE.PerspectiveCamera(28, 1, 0.05, 60);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.enableDamping = true;
    this.controls.minDistance = 0.3;
    this.controls.maxDistance = 12;
    this.playing = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    root.append(this.renderer.domElement);
    new ResizeObserver(() => this.resize()).observe(root);
    this.resize();
    this.frame();
  }

  get #rootPosition() { return this.avatar.root.getWorldPosition(new THREE.Vector3()); }

  /** Puts the camera in front of the person as it stands now. */
  frame() {
    const box = this.avatar.posedBox();
    const size = box.getSize(new THREE.Vector3());
    const centre = box.getCenter(new THREE.Vector3());
    const half = THREE.MathUtils.degToRad(this.camera.fov / 2);
    const distance = (0.5 * ROOM_AROUND * Math.max(size.y, size.x / this.camera.aspect)) / Math.tan(half) + size.z / 2;
    this.floor.position.set(centre.x, 0, centre.z);
    this.controls.target.copy(centre);
    this.camera.position.set(centre.x, centre.y + 0.12 * distance, centre.z + distance);
    this.anchor = this.#rootPosition;
    this.follow();
    this.controls.update();
  }

  /** Moves camera, light and floor with the hips, so that a walking person stays in the picture. */
  follow() {
    const now = this.#rootPosition;
    const step = now.clone().sub(this.anchor).setY(0);
    this.camera.position.add(step);
    this.controls.target.add(step);
    this.floor.position.add(step);
    this.key.target.position.copy(now);
    this.key.position.copy(now).add(new THREE.Vector3(1.3, 2.6, 2.2));
    this.anchor.copy(now);
  }

  /** Turns the camera about the person (rad) and multiplies its distance, as far as dragging could. */
  orbit(azimuth_rad, polar_rad, scale = 1) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const sphere = new THREE.Spherical().setFromVector3(offset);
    sphere.theta += azimuth_rad;
    sphere.phi += polar_rad;
    sphere.radius = THREE.MathUtils.clamp(sphere.radius * scale, this.controls.minDistance, this.controls.maxDistance);
    this.camera.position.copy(this.controls.target).add(offset.setFromSpherical(sphere.makeSafe()));
    this.controls.update();
  }

  /** Handles a key of the view; returns false for others. */
  press(key) {
    const moves = {
      ArrowLeft: [-KEY_TURN_RAD, 0], ArrowRight: [KEY_TURN_RAD, 0], ArrowUp: [0, -KEY_TURN_RAD], ArrowDown: [0, KEY_TURN_RAD],
      "+": [0, 0, 1 / KEY_ZOOM], "=": [0, 0, 1 / KEY_ZOOM], "-": [0, 0, KEY_ZOOM],
    };
    if (key in moves) this.orbit(...moves[key]);
    else if (key === "Home") this.frame();
    else return false;
    return true;
  }

  resize() {
    if (this.renderer.xr.isPresenting) return;
    const { clientWidth, clientHeight } = this.root;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
    this.camera.updateProjectionMatrix();
  }

  step(delta_s) {
    if (this.playing) this.avatar.mixer.update(delta_s);
    if (!this.renderer.xr.isPresenting) {
      this.follow();
      this.controls.update(delta_s);
    }
    this.renderer.render(this.scene, this.camera);
  }
}
