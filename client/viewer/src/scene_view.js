// What is static or follows a script, and the ground.
import * as THREE from 'three';
import { geometryOf, litMaterial } from './geometry.js';
import { keysOf, periodOf, scriptedPose } from './mover.js';
import { piecesOf, vectorOf } from './shapes.js';

export const background = 0x14171b;
const ground = 0x22272d, groundLine = 0x30363e;
const staticColour = [0.36, 0.39, 0.43], terrainColour = [0.22, 0.25, 0.28], moverColour = [0.62, 0.60, 0.56];
const mostTriangles = 200_000;  // through which clicks are traced
const levelNormal = 0.99;
const up = new THREE.Vector3(0, 0, 1);

export class SceneView {
  // `software`: there is no graphics card. Then level ground is lines alone: to fill it takes longer than all the rest.
  constructor(scene, software) {
    this.software = software;
    this.group = new THREE.Group();
    scene.add(this.group);
    this.movers = [];  // { object, keys, period }
    this.solid = [];   // meshes that hide what is behind them
    this.heights = []; // of level planes
    this.uneven = false; // there is ground that is not level
  }

  // `fixed`: FixedBody messages. `size`: how far the ground has to reach, m.
  set(fixed, size) {
    this.#clear();
    let triangles = 0;
    this.uneven = fixed.some(({ shape }) => shape?.mesh || shape?.heightfield);
    for (const body of fixed) {
      const keys = keysOf(body);
      const moves = keys.length > 1;
      const object = body.shape?.plane ? planeObject(body.shape.plane, size, this.software) : solidObject(body.shape, moves);
      placeAt(object, scriptedPose(keys, periodOf(body), 0));
      this.group.add(object);
      const normal = body.shape?.plane ? vectorOf(body.shape.plane.normal) : [0, 0, 0];
      if (normal[1] > levelNormal * Math.hypot(...normal)) this.heights.push(body.shape.plane.offset + keys[0].position[1]);
      if (moves) this.movers.push({ object, keys, period: periodOf(body) });
      object.traverse((part) => {
        if (!part.isMesh) return;
        triangles += (part.geometry.index ?? part.geometry.getAttribute('position')).count / 3;
        this.solid.push(part);
      });
    }
    if (triangles > mostTriangles) this.solid = [];
  }

  // True when something has moved.
  update(seconds) {
    for (const { object, keys, period } of this.movers) placeAt(object, scriptedPose(keys, period, seconds));
    return this.movers.length > 0;
  }

  // How far along the ray something fixed is; Infinity for nothing.
  distance(origin, direction) {
    const caster = new THREE.Raycaster(new THREE.Vector3(...origin), new THREE.Vector3(...direction));
    this.group.updateMatrixWorld();
    return caster.intersectObjects(this.solid, false)[0]?.distance ?? Infinity;
  }

  // A box around all but planes; empty when there is nothing.
  bounds() {
    const out = new THREE.Box3();
    for (const object of this.group.children) if (!object.userData.endless) out.expandByObject(object);
    return out;
  }

  // Of the highest level plane; null when there is none.
  groundHeight() {
    return this.heights.length > 0 ? Math.max(...this.heights) : null;
  }

  #clear() {
    this.group.traverse((part) => {
      part.geometry?.dispose();
      part.material?.dispose();
    });
    this.group.clear();
    this.movers = [];
    this.solid = [];
    this.heights = [];
  }
}

function placeAt(object, { position, orientation }) {
  object.position.set(...position);
  object.quaternion.set(...orientation);
}

function solidObject(shape, moves) {
  const group = new THREE.Group();
  for (const piece of piecesOf(shape)) {
    const open = piece.kind === 'mesh' || piece.kind === 'heightfield';
    const colour = moves ? moverColour : open ? terrainColour : staticColour;
    const material = litMaterial(colour, open ? THREE.DoubleSide : THREE.FrontSide);
    const mesh = new THREE.Mesh(geometryOf(piece), material);
    placeAt(mesh, piece);
    mesh.scale.set(...piece.scale);
    group.add(mesh);
  }
  return group;
}

// A disc that fades out, with lines every so many metres.
function planeObject({ normal, offset }, size, linesOnly) {
  const n = new THREE.Vector3(...vectorOf(normal)).normalize();
  const group = new THREE.Group();
  const turned = new THREE.Group();
  turned.quaternion.setFromUnitVectors(up, n);
  turned.position.copy(n).multiplyScalar(offset);
  turned.add(lines(size));
  if (!linesOnly || n.y < levelNormal) turned.add(disc(size));
  group.add(turned);
  group.userData.endless = true;
  return group;
}

function fade(geometry, size, colour) {
  const near = new THREE.Color(colour), far = new THREE.Color(background), mixed = new THREE.Color();
  const position = geometry.getAttribute('position');
  const colours = new Float32Array(3 * position.count);
  for (let i = 0; i < position.count; ++i) {
    const share = Math.hypot(position.getX(i), position.getY(i)) / size;
    mixed.lerpColors(near, far, Math.min(1, Math.max(0, (share - 0.3) / 0.7)));
    mixed.toArray(colours, 3 * i);
  }
  geometry.setAttribute('color', new THREE.BufferAttribute(colours, 3));
  return geometry;
}

function disc(size) {
  const material = new THREE.MeshBasicMaterial({
    vertexColors: true, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1, side: THREE.DoubleSide,
  });
  return new THREE.Mesh(fade(new THREE.RingGeometry(0, size, 48, 6), size, ground), material);
}

function lines(size) {
  const step = size > 1500 ? 100 : size > 250 ? 20 : size > 100 ? 10 : 5;
  const reach = Math.floor(size / step), parts = 4;
  const points = [];
  for (let i = -reach; i <= reach; ++i) {
    const across = i * step;
    const half = Math.sqrt(Math.max(0, size * size - across * across));
    for (let k = 0; k < parts; ++k) {
      const a = -half + (2 * half * k) / parts, b = -half + (2 * half * (k + 1)) / parts;
      points.push(a, across, 0, b, across, 0, across, a, 0, across, b, 0);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.Float32BufferAttribute(points, 3));
  return new THREE.LineSegments(fade(geometry, size, groundLine), new THREE.LineBasicMaterial({ vertexColors: true }));
}
