// Checks an avatar's files with the readers of the web: node web_readers.mjs MODULES_FOLDER AVATAR_DIR
//
// The Khronos validator finds neither errors nor warnings in avatar.glb; three.js opens avatar.glb and avatar.dae, and
// in every pose, also those of the clips, both show the same body. Prints a line for each check, as check_avatar.py
// does; exit status 1 when one failed.

import fs from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';
import { pathToFileURL } from 'node:url';

const [modules, folder] = process.argv.slice(2);
const module = (name) => import(pathToFileURL(createRequire(path.join(modules, 'package.json')).resolve(name)).href);

// Before there is a document, which it would take for a browser's.
const validator = (await module('gltf-validator')).default;

// ---- what three.js expects of a browser -------------------------------------------------------------------------------

/** An image element whose pictures are loaded at once, without pixels. */
class FakeImage {
  constructor() {
    this.listeners = {};
    this.width = this.height = 4;
  }
  addEventListener(event, listener) {
    (this.listeners[event] ??= []).push(listener);
  }
  removeEventListener() {}
  set src(url) {
    FakeImage.urls.push(url);
    setTimeout(() => (this.listeners.load ?? []).forEach((listener) => listener.call(this)), 0);
  }
}
FakeImage.urls = [];
globalThis.self = globalThis;
globalThis.document = { createElementNS: () => new FakeImage() };
const { DOMParser } = await module('@xmldom/xmldom');
globalThis.DOMParser = DOMParser;

const THREE = await module('three');
const { GLTFLoader } = await module('three/examples/jsm/loaders/GLTFLoader.js');
const { ColladaLoader } = await module('three/examples/jsm/loaders/ColladaLoader.js');

// ---- the two files ----------------------------------------------------------------------------------------------------

function require(condition, message) {
  if (!condition) throw new Error(message);
}

const file = (name) => fs.readFileSync(path.join(folder, name));
const metadata = JSON.parse(file('metadata.json'));
const rigged = metadata.joints > 0;

/** One opened file: its scene, its mesh, its joints by name, its clips. */
class Opened {
  constructor(scene, clips) {
    this.scene = scene;
    this.clips = clips;
    this.meshes = [];
    this.joints = {};
    scene.traverse((node) => {
      if (node.isMesh) this.meshes.push(node);
      if (node.isBone) this.joints[node.name] = node;
    });
    this.mesh = this.meshes[0];
    this.mixer = new THREE.AnimationMixer(scene);
  }

  /** The place of every corner of every triangle in the world, as posed now. */
  corners() {
    this.scene.updateMatrixWorld(true);
    if (this.mesh.skeleton) this.mesh.skeleton.update();
    const { position } = this.mesh.geometry.attributes;
    const index = this.mesh.geometry.index;
    const count = index ? index.count : position.count;
    const result = new Float64Array(3 * count);
    const at = new THREE.Vector3();
    for (let corner = 0; corner < count; ++corner) {
      const vertex = index ? index.getX(corner) : corner;
      at.fromBufferAttribute(position, vertex);
      if (this.mesh.isSkinnedMesh) this.mesh.applyBoneTransform(vertex, at);
      at.applyMatrix4(this.mesh.matrixWorld);
      at.toArray(result, 3 * corner);
    }
    return result;
  }

  /** Takes the pose that a clip has at a time. */
  play(clip, time_s) {
    this.mixer.stopAllAction();
    this.mixer.clipAction(clip).play();
    this.mixer.setTime(time_s);
  }
}

async function open_glb() {
  const bytes = file('avatar.glb');
  const loaded = await new Promise((resolve, reject) =>
    new GLTFLoader().parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), '', resolve, reject));
  return new Opened(loaded.scene, loaded.animations);
}

function open_dae() {
  const loaded = new ColladaLoader().parse(file('avatar.dae').toString(), 'folder/');
  return new Opened(loaded.scene, loaded.scene.animations);
}

let glb, dae;
const near_m = 1e-4;

function largest_distance(a, b) {
  require(a.length === b.length, `${a.length / 9} and ${b.length / 9} triangles`);
  let largest = 0;
  for (let i = 0; i < a.length; i += 3)
    largest = Math.max(largest, Math.hypot(a[i] - b[i], a[i + 1] - b[i + 1], a[i + 2] - b[i + 2]));
  return largest;
}

// ---- the checks -------------------------------------------------------------------------------------------------------

async function khronos_validator_finds_nothing() {
  const { issues } = await validator.validateBytes(new Uint8Array(file('avatar.glb')), { maxIssues: 20 });
  require(issues.numErrors === 0 && issues.numWarnings === 0, JSON.stringify(issues.messages.slice(0, 3)));
}

async function three_opens_both() {
  glb = await open_glb();
  dae = open_dae();
  for (const [name, opened] of [['avatar.glb', glb], ['avatar.dae', dae]]) {
    require(opened.meshes.length === 1, `${name}: ${opened.meshes.length} meshes`);
    require(opened.corners().length === 9 * metadata.triangles, `${name}: ${opened.corners().length / 9} triangles`);
    require(opened.mesh.material.map, `${name}: no texture`);
    require(Object.keys(opened.joints).length === metadata.joints, `${name}: ${Object.keys(opened.joints).length} joints`);
  }
  require(FakeImage.urls.some((url) => url.startsWith('folder/texture.')), 'avatar.dae names no texture beside it');
  const error = largest_distance(glb.corners(), dae.corners());
  require(error < near_m, `the files differ by ${error} m`);
}

/** Every joint, turned alone, moves the same corners to the same places, and not all of them but the root's. */
function three_poses_both_alike() {
  const rest = glb.corners();
  for (const name of Object.keys(glb.joints)) {
    const turn = new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(1, 0.4, -0.3).normalize(), 0.6);
    const before = [glb, dae].map((opened) => opened.joints[name].quaternion.clone());
    for (const opened of [glb, dae]) opened.joints[name].quaternion.multiply(turn);
    const posed = [glb.corners(), dae.corners()];
    [glb, dae].forEach((opened, i) => opened.joints[name].quaternion.copy(before[i]));
    const error = largest_distance(...posed);
    require(error < near_m, `turning ${name}: the files differ by ${error} m`);
    const moved = largest_distance(posed[0], rest);
    require(moved > 0.01 || name.endsWith('_End'), `turning ${name} moves nothing`);
  }
}

/** The clips of avatar.glb are those of avatar.dae, one after the other; all the while the body stays above the floor. */
function three_plays_both_alike() {
  require(glb.clips.length === 2 && dae.clips.length === 1, `${glb.clips.length} and ${dae.clips.length} clips`);
  let floor = Infinity;
  glb.corners().forEach((value, i) => (floor = i % 3 === 1 ? Math.min(floor, value) : floor));
  let begin_s = 0;
  for (const clip of glb.clips) {
    for (const share of [0, 0.21, 0.5, 0.77, 0.95]) {
      const time_s = share * clip.duration;
      glb.play(clip, time_s);
      dae.play(dae.clips[0], begin_s + time_s);
      const posed = glb.corners();
      const error = largest_distance(posed, dae.corners());
      require(error < 1e-3, `${clip.name} at ${time_s} s: the files differ by ${error} m`);
      let lowest = Infinity;
      posed.forEach((value, i) => (lowest = i % 3 === 1 ? Math.min(lowest, value) : lowest));
      require(Math.abs(lowest - floor) < 0.003, `${clip.name} at ${time_s} s: the soles are at ${lowest} m`);
    }
    begin_s += clip.duration;
  }
}

const checks = [khronos_validator_finds_nothing, three_opens_both];
if (rigged) checks.push(three_poses_both_alike);
if (file('avatar.dae').includes('<library_animations>')) checks.push(three_plays_both_alike);
let failures = 0;
for (const check of checks) {
  const name = check.name.replaceAll('_', ' ');
  try {
    await check();
    console.log(`ok       ${name}`);
  } catch (fault) {
    ++failures;
    console.log(`FAILED   ${name}: ${fault.message}`);
  }
}
process.exit(failures > 0 ? 1 : 0);
