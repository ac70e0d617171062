// The avatar in the 3D view: its levels of detail on one skeleton, surfaces, clips and morph targets.
import * as THREE from "three";

export const ACCENT = 0x2f7df6;
const CLAY = new THREE.MeshStandardMaterial({ color: 0xb9b4ae, roughness: 0.85, metalness: 0 });
const WIRE = new THREE.MeshBasicMaterial({ color: ACCENT, wireframe: true, transparent: true, opacity: 0.35 });

function skinnedMeshes(root) {
  const meshes = [];
  root.traverse((node) => { if (node.isSkinnedMesh) meshes.push(node); });
  return meshes;
}

function triangleCount(meshes) {
  return meshes.reduce((sum, { geometry }) => sum + (geometry.index ?? geometry.attributes.position).count / 3, 0);
}

function unlitMaterial(lit) {
  return new THREE.MeshBasicMaterial({ color: lit.color, map: lit.map, side: lit.side, vertexColors: lit.vertexColors });
}

export class Avatar {
  /** `levels`: glTF files of coarser levels, finest first; their skins have the joints of `gltf`, by name. */
  constructor(gltf, levels = [], coverageMap = null) {
    this.model = gltf.scene;
    const finest = skinnedMeshes(this.model);
    if (finest.length === 0) throw new Error("the file holds no skinned mesh");
    this.levels = [finest, ...levels.map((level) => this.#adoptLevel(level, finest[0]))];
    this.triangles = this.levels.map(triangleCount);
    this.surfaces = ["lit", "unlit", "clay", ...(coverageMap ? ["coverage"] : [])];
    const coverage = new THREE.MeshStandardMaterial({ map: coverageMap, roughness: 0.9, metalness: 0 });
    this.wires = [];
    for (const mesh of this.levels.flat()) {
      mesh.castShadow = true;
      mesh.frustumCulled = false;
      mesh.userData.materials = { lit: mesh.material, unlit: unlitMaterial(mesh.material), clay: CLAY, coverage };
      this.wires.push(this.#addWire(mesh));
    }
    this.skeleton = finest[0].skeleton;
    this.root = this.skeleton.bones[0];
    this.bones = new THREE.SkeletonHelper(this.root);
    Object.assign(this.bones.material, { depthTest: false, transparent: true, vertexColors: false });
    this.bones.material.color.set(ACCENT);
    this.morphs = this.#findMorphs();
    this.clips = gltf.animations;
    this.mixer = new THREE.AnimationMixer(this.model);
    this.level = 0;
    this.setSurface("lit");
    this.setWireframe(false);
    this.setSkeleton(false);
    this.setClip(this.clips.length > 0 ? 0 : -1);
  }

  #adoptLevel(level, finest) {
    const meshes = skinnedMeshes(level.scene);
    const bone = new Map(finest.skeleton.bones.map((joint) => [joint.name, joint]));
    for (const mesh of meshes) {
      const joints = mesh.skeleton.bones.map(({ name }) => bone.get(name));
      if (joints.includes(undefined)) throw new Error("a level of detail has other joints than the avatar");
      finest.parent.add(mesh);
      mesh.bind(new THREE.Skeleton(joints, mesh.skeleton.boneInverses), mesh.bindMatrix);
    }
    return meshes;
  }

  #addWire(mesh) {
    const wire = new THREE.SkinnedMesh(mesh.geometry, WIRE);
    wire.frustumCulled = false;
    wire.bind(mesh.skeleton, mesh.bindMatrix);
    if (mesh.morphTargetInfluences) wire.morphTargetInfluences = mesh.morphTargetInfluences;
    mesh.add(wire);
    return wire;
  }

  /** Morph targets by name: every mesh and index that has it. */
  #findMorphs() {
    const found = new Map();
    for (const mesh of this.levels.flat()) {
      for (const [name, index] of Object.entries(mesh.morphTargetDictionary ?? {})) {
        found.set(name, [...(found.get(name) ?? []), { mesh, index }]);
      }
    }
    return found;
  }

  /** The shown meshes; the coverage map has the texture coordinates of the finest level only. */
  get meshes() { return this.levels[this.surface === "coverage" ? 0 : this.level]; }
  get clip() { return this.clips[this.clipIndex]; }
  get duration() { return this.clip ? this.clip.duration : 0; }
  get time() { return this.action ? this.action.time : 0; }

  setSurface(name) {
    this.surface = name;
    for (const mesh of this.levels.flat()) mesh.material = mesh.userData.materials[name];
    this.#showLevel();
  }

  setLevel(level) {
    this.level = level;
    this.#showLevel();
  }

  #showLevel() {
    for (const meshes of this.levels) meshes.forEach((mesh) => { mesh.visible = meshes === this.meshes; });
  }

  setWireframe(isOn) { this.wires.forEach((wire) => { wire.visible = isOn; }); }
  setSkeleton(isOn) { this.bones.visible = isOn; }

  setMorph(name, weight) {
    for (const { mesh, index } of this.morphs.get(name)) mesh.morphTargetInfluences[index] = weight;
  }

  morphWeight(name) {
    const [{ mesh, index }] = this.morphs.get(name);
    return mesh.morphTargetInfluences[index];
  }

  /** Plays a clip from its start; -1 holds the rest pose. */
  setClip(index) {
    this.clipIndex = index;
    this.mixer.stopAllAction();
    this.action = this.clip ? this.mixer.clipAction(this.clip).reset().play() : null;
    if (!this.action) this.levels.flat().forEach((mesh) => mesh.skeleton.pose());
    this.mixer.update(0);
  }

  seek(time_s) {
    if (!this.action) return;
    this.action.time = time_s;
    this.mixer.update(0);
  }

  /** World-space box of the vertices of the shown level in the pose that the skeleton holds now. */
  posedBox() {
    const box = new THREE.Box3();
    this.model.updateMatrixWorld(true);
    for (const mesh of this.meshes) {
      mesh.skeleton.update();
      mesh.computeBoundingBox();
      box.union(mesh.boundingBox.clone().applyMatrix4(mesh.matrixWorld));
    }
    return box;
  }
}
