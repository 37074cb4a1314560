// Two ways to draw many copies of one geometry. A graphics card draws instances; software renderers take about as long
// for an instance as for a draw call, and their time goes by corners: for them the copies are put into one geometry,
// lit already, and without the triangles that face away.
import * as THREE from 'three';
import { lightAt } from './geometry.js';

export class InstancedLevel {
  constructor(scene, geometry, material) {
    Object.assign(this, { scene, geometry, material, mesh: null, count: 0 });
  }

  resize(capacity) {
    if (this.mesh !== null) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    const mesh = (this.mesh = new THREE.InstancedMesh(this.geometry, this.material, capacity));
    mesh.instanceColor = new THREE.InstancedBufferAttribute(new Float32Array(3 * capacity), 3);
    mesh.instanceMatrix.setUsage(THREE.DynamicDrawUsage);
    mesh.instanceColor.setUsage(THREE.DynamicDrawUsage);
    addTo(this.scene, mesh);
  }

  begin() {
    this.count = 0;
  }

  // One copy, with the matrix and the colour of this place.
  show(matrices, colours, place) {
    const matrix = this.mesh.instanceMatrix.array, colour = this.mesh.instanceColor.array, to = this.count++;
    for (let i = 0, a = 16 * to, b = 16 * place; i < 16; ++i) matrix[a++] = matrices[b++];
    for (let i = 0, a = 3 * to, b = 3 * place; i < 3; ++i) colour[a++] = colours[b++];
  }

  end() {
    this.mesh.count = this.count;
    this.mesh.visible = this.count > 0;
    upload(this.mesh.instanceMatrix, 16 * this.count);
    upload(this.mesh.instanceColor, 3 * this.count);
  }
}

export class MergedLevel {
  constructor(scene, geometry) {
    this.scene = scene;
    this.positions = geometry.getAttribute('position').array;
    this.normals = geometry.getAttribute('normal').array;
    this.shades = geometry.getAttribute('shade').array;
    this.corners = this.shades.length;
    this.index = geometry.index?.array ?? Uint32Array.from({ length: this.corners }, (_, i) => i);
    this.planes = planesOf(this.positions, this.index);
    this.drawn = 0;  // indices
    this.material = new THREE.MeshBasicMaterial({ vertexColors: true });
    this.mesh = null;
    this.count = 0;
  }

  resize(capacity) {
    if (this.mesh !== null) {
      this.scene.remove(this.mesh);
      this.mesh.geometry.dispose();
    }
    const geometry = new THREE.BufferGeometry();
    const { corners, index } = this;
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(capacity * index.length), 1));
    geometry.index.setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(3 * corners * capacity), 3));
    geometry.setAttribute('color', new THREE.BufferAttribute(new Uint8Array(4 * corners * capacity), 4, true));
    for (const name of ['position', 'color']) geometry.getAttribute(name).setUsage(THREE.DynamicDrawUsage);
    this.mesh = new THREE.Mesh(geometry, this.material);
    addTo(this.scene, this.mesh);
  }

  begin() {
    this.count = 0;
    this.drawn = 0;
  }

  show(matrices, colours, place, eye) {
    this.#addTriangles(matrices, 16 * place, eye);
    const { positions, normals, shades, corners } = this;
    const to = this.mesh.geometry.getAttribute('position').array, light = this.mesh.geometry.getAttribute('color').array;
    const at = 16 * place;
    const a = matrices[at], b = matrices[at + 1], c = matrices[at + 2], d = matrices[at + 4], e = matrices[at + 5];
    const f = matrices[at + 6], g = matrices[at + 8], h = matrices[at + 9], i = matrices[at + 10];
    const tx = matrices[at + 12], ty = matrices[at + 13], tz = matrices[at + 14];
    const red = 255 * colours[3 * place], green = 255 * colours[3 * place + 1], blue = 255 * colours[3 * place + 2];
    let out = 3 * corners * this.count, outLight = 4 * corners * this.count;
    for (let corner = 0, from = 0; corner < corners; ++corner, from += 3) {
      const x = positions[from], y = positions[from + 1], z = positions[from + 2];
      to[out++] = a * x + d * y + g * z + tx;
      to[out++] = b * x + e * y + h * z + ty;
      to[out++] = c * x + f * y + i * z + tz;
      const l = normals[from], m = normals[from + 1], n = normals[from + 2];
      const u = a * l + d * m + g * n, v = b * l + e * m + h * n, w = c * l + f * m + i * n;
      const bright = shades[corner] * lightAt(u, v, w);
      light[outLight++] = Math.min(255, red * bright);
      light[outLight++] = Math.min(255, green * bright);
      light[outLight++] = Math.min(255, blue * bright);
      light[outLight++] = 255;
    }
    ++this.count;
  }

  end() {
    const { geometry } = this.mesh;
    geometry.setDrawRange(0, this.drawn);
    upload(geometry.index, this.drawn);
    this.mesh.visible = this.count > 0;
    upload(geometry.getAttribute('position'), 3 * this.corners * this.count);
    upload(geometry.getAttribute('color'), 4 * this.corners * this.count);
  }

  // Those whose front the eye sees. Which side of a plane it is on does not change when all is stretched.
  #addTriangles(m, at, eye) {
    const { index, planes } = this;
    const x = eye.x - m[at + 12], y = eye.y - m[at + 13], z = eye.z - m[at + 14];
    // The eye in the geometry's own frame: the matrix's columns are at right angles.
    const own = [0, 4, 8].map((column) => {
      const a = m[at + column], b = m[at + column + 1], c = m[at + column + 2];
      return (a * x + b * y + c * z) / (a * a + b * b + c * c);
    });
    const [ex, ey, ez] = own;
    const to = this.mesh.geometry.index.array, first = this.count * this.corners;
    for (let i = 0, plane = 0; i < index.length; i += 3, plane += 4) {
      if (planes[plane] * ex + planes[plane + 1] * ey + planes[plane + 2] * ez <= planes[plane + 3]) continue;
      to[this.drawn++] = first + index[i];
      to[this.drawn++] = first + index[i + 1];
      to[this.drawn++] = first + index[i + 2];
    }
  }
}

// Of each triangle: its normal (of any length), and what the normal times its points is.
function planesOf(positions, index) {
  const planes = new Float32Array((index.length / 3) * 4);
  const a = new THREE.Vector3(), b = new THREE.Vector3(), c = new THREE.Vector3();
  for (let i = 0, to = 0; i < index.length; i += 3) {
    a.fromArray(positions, 3 * index[i]);
    b.fromArray(positions, 3 * index[i + 1]).sub(a);
    c.fromArray(positions, 3 * index[i + 2]).sub(a);
    b.cross(c).toArray(planes, to);
    planes[to + 3] = b.dot(a);
    to += 4;
  }
  return planes;
}

function addTo(scene, mesh) {
  mesh.frustumCulled = false;  // what is out of view is not in it
  mesh.matrixAutoUpdate = false;
  mesh.renderOrder = 2;  // after the ground and the borders
  mesh.visible = false;
  scene.add(mesh);
}

function upload(attribute, length) {
  if (length === 0) return;
  attribute.clearUpdateRanges();
  attribute.addUpdateRange(0, length);
  attribute.needsUpdate = true;
}
