// The avatar in a headset (WebXR): at true scale on the floor of the room; sticks walk and turn, the trigger pauses.
import * as THREE from "three";

const DISTANCE_M = 2;
const WALK_M_PER_S = 1.5;
const TURN_RAD = Math.PI / 6;
const STICK_REST = 0.2;
const STICK_PRESSED = 0.7;
const BACKGROUND = 0xdfe3e8;

/** The stick of a controller as [x, y] in [-1, 1], y forward; [0, 0] near its centre ("xr-standard" gamepad). */
export function stick(gamepad) {
  const axes = gamepad?.axes ?? [];
  const [x, y] = axes.length >= 4 ? axes.slice(2, 4) : axes;
  const live = (value) => (Math.abs(value ?? 0) < STICK_REST ? 0 : value);
  return [live(x), 0 - live(y)];
}

/** Where the visitor's play space stands in the scene, and how sticks move it. */
export class Visitor {
  constructor(camera) {
    this.space = new THREE.Group();
    this.camera = camera;
    this.mayTurn = true;
  }

  /** Moves by sticks. left: walks in all directions. right: walks forward and back, turns by steps. */
  move(left, right, delta_s) {
    const ahead = this.camera.getWorldDirection(new THREE.Vector3()).setY(0).normalize();
    const aside = new THREE.Vector3(-ahead.z, 0, ahead.x);
    const metres = WALK_M_PER_S * delta_s;
    this.space.position.addScaledVector(ahead, metres * THREE.MathUtils.clamp(left[1] + right[1], -1, 1));
    this.space.position.addScaledVector(aside, metres * left[0]);
    if (Math.abs(right[0]) > STICK_PRESSED && this.mayTurn) this.#turn(-Math.sign(right[0]) * TURN_RAD);
    this.mayTurn = Math.abs(right[0]) < STICK_PRESSED;
  }

  /** Turns about the head, not about the origin of the room. */
  #turn(angle_rad) {
    this.space.updateMatrixWorld(true);
    const head = this.camera.getWorldPosition(new THREE.Vector3());
    const up = new THREE.Vector3(0, 1, 0);
    const y = this.space.position.y;
    this.space.position.sub(head).applyAxisAngle(up, angle_rad).add(head).setY(y);
    this.space.rotateY(angle_rad);
  }
}

async function enter(view, onTrigger, onEnd) {
  const session = await navigator.xr.requestSession("immersive-vr", { requiredFeatures: ["local-floor"] });
  const { renderer, camera, scene, key } = view;
  const before = { position: camera.position.clone(), quaternion: camera.quaternion.clone(), fov: camera.fov };
  const visitor = new Visitor(camera);
  const at = view.avatar.root.getWorldPosition(new THREE.Vector3());
  visitor.space.position.set(at.x, 0, at.z + DISTANCE_M);
  visitor.space.add(camera);
  scene.add(visitor.space);
  scene.background = new THREE.Color(BACKGROUND);
  key.castShadow = false; // the shadow map would draw the avatar once more
  view.controls.enabled = false;
  session.addEventListener("select", onTrigger);
  session.addEventListener("end", () => {
    scene.remove(visitor.space);
    visitor.space.remove(camera);
    scene.background = null;
    key.castShadow = true;
    view.controls.enabled = true;
    view.visitor = null;
    camera.position.copy(before.position);
    camera.quaternion.copy(before.quaternion);
    camera.fov = before.fov;
    camera.zoom = 1;
    view.resize();
    onEnd();
  });
  renderer.xr.enabled = true;
  renderer.xr.setReferenceSpaceType("local-floor");
  await renderer.xr.setSession(session);
  view.visitor = visitor;
  return session;
}

/** Sticks of the session's controllers, of the left and the right hand; a controller without a hand is the right one. */
export function sticks(session) {
  const found = { left: [0, 0], right: [0, 0] };
  for (const { handedness, gamepad } of session.inputSources) {
    if (gamepad) found[handedness === "left" ? "left" : "right"] = stick(gamepad);
  }
  return found;
}

/** Moves the visitor of a running session; call once a frame. */
export function stepVisitor(view, delta_s) {
  const session = view.renderer.xr.getSession();
  if (!session || !view.visitor) return;
  const { left, right } = sticks(session);
  view.visitor.move(left, right, delta_s);
}

/** Returns a button that enters and leaves the headset; null where there is none. */
export async function headsetButton(view, makeButton, onTrigger) {
  const isSupported = await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false);
  if (!isSupported) return null;
  const hint = "Stand before the avatar in a headset: sticks walk and turn, the trigger pauses";
  const element = makeButton("Enter VR", hint, async () => {
    const running = view.renderer.xr.getSession();
    if (running) { await running.end(); return; }
    try {
      await enter(view, onTrigger, () => { element.textContent = "Enter VR"; });
      element.textContent = "Leave VR";
    } catch (error) {
      element.title = `The headset cannot be used: ${error.message}`;
      element.textContent = "No VR";
      element.disabled = true;
    }
  });
  return element;
}
