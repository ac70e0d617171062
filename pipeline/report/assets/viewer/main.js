// The 3D view of the report page: an avatar.glb with its clips, morph targets, skeleton and levels of detail.
// `viewer.min.js` in the folder above is this source bundled with three.js; README.md there says how to rebuild it.
import * as THREE from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { Avatar } from "./avatar.js";
import { stepVisitor } from "./headset.js";
import { addControls } from "./panel.js";
import { AvatarView } from "./view.js";

const MAX_STEP_S = 0.1;

/** Bytes of a base64 string: `fetch` of a data URI is refused by some browsers on file:// pages. */
function decodeBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
  return bytes.buffer;
}

async function loadMap(uri) {
  const map = await new THREE.TextureLoader().loadAsync(uri);
  map.flipY = false; // as textures of glTF
  map.colorSpace = THREE.SRGBColorSpace;
  return map;
}

/**
 * Shows an avatar inside the element `root`; resolves with the view, rejects with a reason.
 * glb: base64 of the .glb. levels: base64 of coarser levels, finest first. coverage: data URI of an image, or null.
 */
export async function mount(root, { glb, levels = [], coverage = null }) {
  const loader = new GLTFLoader();
  const files = await Promise.all([glb, ...levels].map((text) => loader.parseAsync(decodeBase64(text), "")));
  const avatar = new Avatar(files[0], files.slice(1), coverage && (await loadMap(coverage)));
  const picture = document.createElement("div");
  picture.className = "viewer-picture";
  root.replaceChildren(picture);
  const view = new AvatarView(picture, avatar);
  const player = await addControls(root, view);
  let onScreen = true;
  new IntersectionObserver(([entry]) => { onScreen = entry.isIntersecting; }).observe(picture);
  const clock = new THREE.Clock();
  view.renderer.setAnimationLoop(() => {
    const delta_s = Math.min(clock.getDelta(), MAX_STEP_S);
    if (!onScreen && !view.renderer.xr.isPresenting) return;
    stepVisitor(view, delta_s);
    view.step(delta_s);
    if (view.playing) player.show();
  });
  root.dataset.ready = "true";
  return view;
}
