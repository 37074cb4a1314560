// Geometries of pieces, with few triangles: software renderers draw thousands of them.
import * as THREE from 'three';
import { ConvexGeometry } from 'three/examples/jsm/geometries/ConvexGeometry.js';
import { mergeVertices } from 'three/examples/jsm/utils/BufferGeometryUtils.js';

// A shade per vertex, so that one sees round bodies turn.
function withShade(geometry, shadeAt) {
  const position = geometry.getAttribute('position');
  const shade = new Float32Array(position.count);
  for (let i = 0; i < position.count; ++i) shade[i] = shadeAt(position.getX(i), position.getY(i), position.getZ(i));
  geometry.setAttribute('shade', new THREE.BufferAttribute(shade, 1));
  geometry.deleteAttribute('uv');
  return geometry;
}

const plain = () => 1;
const halves = (x, y, z) => (x * 0.8 + y * 0.5 + z * 0.33 > 0 ? 1 : 0.78);

function sphere(fine) {
  const geometry = fine ? new THREE.IcosahedronGeometry(1, 2) : new THREE.OctahedronGeometry(1, 1);
  geometry.deleteAttribute('uv');
  geometry.deleteAttribute('normal');
  const merged = mergeVertices(geometry);
  merged.setAttribute('normal', merged.getAttribute('position').clone());
  return withShade(merged, halves);
}

function cylinder(fine) {
  return withShade(new THREE.CylinderGeometry(1, 1, 1, fine ? 16 : 7, 1), (x) => (x > 0 ? 1 : 0.8));
}

function capsule(fine, { middle, r }) {
  return withShade(new THREE.CapsuleGeometry(1, (2 * middle) / r, fine ? 4 : 1, fine ? 12 : 6), (x) => (x > 0 ? 1 : 0.8));
}

function hull(fine, { points }) {
  return withShade(new ConvexGeometry(points.map((p) => new THREE.Vector3(...p))), plain);
}

function mesh(fine, { mesh: { points, triangles } }) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.Float32BufferAttribute(points.flatMap((p) => [p.x, p.y, p.z]), 3));
  geometry.setIndex([...triangles]);
  const flat = geometry.toNonIndexed();
  flat.computeVertexNormals();
  return withShade(flat, plain);
}

function heightfield(fine, { field }) {
  const { rows, columns, cell, heights } = field;
  const positions = new Float32Array(rows * columns * 3);
  for (let row = 0, at = 0; row < rows; ++row) {
    for (let column = 0; column < columns; ++column) {
      positions[at++] = (column - (columns - 1) / 2) * cell;
      positions[at++] = heights[row * columns + column];
      positions[at++] = (row - (rows - 1) / 2) * cell;
    }
  }
  const index = [];
  for (let row = 0; row + 1 < rows; ++row) {
    for (let column = 0; column + 1 < columns; ++column) {
      const a = row * columns + column, b = a + columns;
      index.push(a, b, a + 1, a + 1, b, b + 1);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(index);
  geometry.computeVertexNormals();
  return withShade(geometry, plain);
}

const makers = {
  sphere, cylinder, capsule, hull, mesh, heightfield,
  box: () => withShade(new THREE.BoxGeometry(1, 1, 1), plain),
};

export function geometryOf(piece, fine = true) {
  return makers[piece.kind](fine, piece);
}

// Whether there is a coarse one as well.
export function isRound(piece) {
  return piece.kind === 'sphere' || piece.kind === 'cylinder' || piece.kind === 'capsule';
}

// Lit by the sky and one sun, per vertex: the cheapest that still shows shapes. Colours are not converted: they are what
// the screen shows.
const vertexShader = `
attribute float shade;
uniform vec3 colour;
varying vec3 vColour;
void main() {
  vec4 at = vec4(position, 1.0);
  vec3 n = normal;
  vec3 own = colour;
  #ifdef USE_INSTANCING
    at = instanceMatrix * at;
    n = mat3(instanceMatrix) * n;
  #endif
  #ifdef USE_INSTANCING_COLOR
    own = instanceColor;
  #endif
  n = normalize(mat3(modelMatrix) * n);
  float light = 0.44 + 0.13 * n.y + 0.48 * max(dot(n, vec3(0.45, 0.78, 0.43)), 0.0);
  vColour = own * shade * light;
  gl_Position = projectionMatrix * modelViewMatrix * at;
}`;

const fragmentShader = `
varying vec3 vColour;
void main() {
  gl_FragColor = vec4(vColour, 1.0);
}`;

// The same, for a normal of any length but 0.
export function lightAt(x, y, z) {
  const scale = 1 / Math.sqrt(x * x + y * y + z * z);
  const sun = (0.45 * x + 0.78 * y + 0.43 * z) * scale;
  return 0.44 + 0.13 * y * scale + (sun > 0 ? 0.48 * sun : 0);
}

export function litMaterial(colour = [1, 1, 1], side = THREE.FrontSide) {
  return new THREE.ShaderMaterial({
    uniforms: { colour: { value: new THREE.Vector3(...colour) } }, vertexShader, fragmentShader, side,
  });
}
