// Region borders, auras, the frame around the selected body and the arrow of a throw.
import * as THREE from 'three';
import { regionColour } from './palette.js';

const postHeight = 3, band = 0.3;  // m
const bandOrder = 1;  // after the ground, before the bodies
const colourOf = (region) => new THREE.Color(...regionColour(region));

// The twelve edges of a box, as pairs of corners.
function pushBox(points, [x0, y0, z0, x1, y1, z1]) {
  for (const [y, u] of [[y0, y0], [y1, y1]]) {
    points.push(x0, y, z0, x1, u, z0, x1, y, z0, x1, u, z1, x1, y, z1, x0, u, z1, x0, y, z1, x0, u, z0);
  }
  for (const [x, z] of [[x0, z0], [x1, z0], [x1, z1], [x0, z1]]) points.push(x, y0, z, x, y1, z);
}

function segments(points, material) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.Float32BufferAttribute(points, 3));
  const out = new THREE.LineSegments(geometry, material);
  out.frustumCulled = false;
  return out;
}

function dispose(group) {
  group.traverse((part) => {
    part.geometry?.dispose();
    part.material?.dispose();
  });
  group.clear();
}

export class Overlays {
  constructor(scene) {
    this.borders = new THREE.Group();
    this.auras = new THREE.Group();
    this.auraOf = new Map();  // by region
    this.frame = segments(boxPoints(), new THREE.LineBasicMaterial({ color: 0xffffff }));
    this.arrow = segments([0, 0, 0, 0, 0, 0], new THREE.LineBasicMaterial({ color: 0xffffff, depthTest: false }));
    this.frame.visible = this.arrow.visible = false;
    scene.add(this.borders, this.auras, this.frame, this.arrow);
    this.auras.visible = false;
  }

  // `rects`: RegionRect messages; `bounds`: THREE.Box3 of what is in the world, to which endless sides are cut; `y`: the
  // ground's height; `through`: show them through what is on it, but not through bodies.
  setBorders(rects, bounds, y, through) {
    dispose(this.borders);
    const margin = 4;
    const clip = (v, least, most) => Math.min(most + margin, Math.max(least - margin, v));
    rects.forEach((rect, region) => {
      const x0 = clip(rect.min_x, bounds.min.x, bounds.max.x), x1 = clip(rect.max_x, bounds.min.x, bounds.max.x);
      const z0 = clip(rect.min_z, bounds.min.z, bounds.max.z), z1 = clip(rect.max_z, bounds.min.z, bounds.max.z);
      if (x1 <= x0 || z1 <= z0) return;
      // A gap, so that both sides of a border show their colour.
      const gap = 0.03;
      this.#addBorder(region, [x0 + gap, z0 + gap, x1 - gap, z1 - gap], y, through);
    });
  }

  // `boxes`: six numbers each.
  setAuras(region, boxes) {
    const old = this.auraOf.get(region);
    if (old !== undefined) {
      this.auras.remove(old);
      old.geometry.dispose();
      old.material.dispose();
    }
    const points = [];
    for (let i = 0; i + 6 <= boxes.length; i += 6) pushBox(points, boxes.slice(i, i + 6));
    const lines = segments(points, new THREE.LineBasicMaterial({ color: colourOf(region), transparent: true, opacity: 0.7 }));
    this.auraOf.set(region, lines);
    this.auras.add(lines);
  }

  clearAuras() {
    dispose(this.auras);
    this.auraOf.clear();
  }

  // Around a body that reaches so far along its axes; null: around none.
  setFrame(pose, extent) {
    this.frame.visible = pose !== null;
    if (pose === null) return;
    this.frame.position.set(pose[0], pose[1], pose[2]);
    this.frame.quaternion.set(pose[3], pose[4], pose[5], pose[6]);
    this.frame.scale.set(...extent.map((v) => v * 1.08 + 0.02));
  }

  // From one point to another; null: none.
  setArrow(from, to) {
    this.arrow.visible = from !== null;
    if (from === null) return;
    const position = this.arrow.geometry.getAttribute('position');
    position.array.set([...from, ...to]);
    position.needsUpdate = true;
  }

  // A band on the ground along the inside, and posts at the corners.
  #addBorder(region, [x0, z0, x1, z1], y, through) {
    const low = y + 0.02;
    const outer = [[x0, z0], [x1, z0], [x1, z1], [x0, z1]];
    const inner = [[x0 + band, z0 + band], [x1 - band, z0 + band], [x1 - band, z1 - band], [x0 + band, z1 - band]];
    const posts = [], strips = [];
    outer.forEach(([ax, az], i) => {
      const next = (i + 1) % 4;
      const [bx, bz] = outer[next], [cx, cz] = inner[next], [dx, dz] = inner[i];
      posts.push(ax, low, az, ax, low + postHeight, az);
      strips.push(ax, low, az, bx, low, bz, cx, low, cz, ax, low, az, cx, low, cz, dx, low, dz);
    });
    const colour = colourOf(region);
    this.borders.add(segments(posts, new THREE.LineBasicMaterial({ color: colour })));
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.Float32BufferAttribute(strips, 3));
    const dark = colour.clone().lerp(new THREE.Color(0x14171b), 0.45);
    const material = new THREE.MeshBasicMaterial({ color: dark, side: THREE.DoubleSide, depthTest: !through });
    const strip = new THREE.Mesh(geometry, material);
    strip.renderOrder = bandOrder;
    this.borders.add(strip);
  }
}

function boxPoints() {
  const points = [];
  pushBox(points, [-1, -1, -1, 1, 1, 1]);
  return points;
}
