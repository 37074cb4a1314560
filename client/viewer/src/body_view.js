// The bodies as they are drawn: their pieces' places, poses and colours. Only what may have changed is touched.
import { geometryOf, isRound, litMaterial } from './geometry.js';
import { Instances } from './instances.js';
import { InstancedLevel, MergedLevel } from './levels.js';
import { bodyColour, highlight } from './palette.js';
import { poseAt } from './pose.js';
import { piecesOf, reachOf, rotate } from './shapes.js';

const flashMs = 700;

// One body is { body (merged), look, pieces, reach, pose (seven numbers, as shown), holders (one per piece), region and
// asleep as coloured, flashed (ms; 0: not), simple (one piece, at the origin) }.
export class BodyView {
  // `software`: there is no graphics card.
  constructor(scene, software) {
    this.scene = scene;
    this.software = software;
    this.material = litMaterial();
    this.views = new Map();      // by id
    this.moving = new Set();     // views whose pose may change with time
    this.flashing = new Set();
    this.instances = new Map();  // by the pieces' key
    this.flashes = false;        // show changes of owners
    this.selected = null;        // id
    this.dirty = true;           // something has to be drawn anew
    this.lookPieces = new Map(); // BodyDescription -> pieces
  }

  reset() {
    for (const instances of this.instances.values()) instances.clear();
    this.views.clear();
    this.moving.clear();
    this.flashing.clear();
    this.lookPieces.clear();
    this.dirty = true;
  }

  changed(body, look, ownerChanged, now) {
    let view = this.views.get(body.id);
    if (view !== undefined && view.look !== look) {
      this.lost(body);
      view = undefined;
    }
    if (view === undefined) view = this.#add(body, look);
    view.body = body;
    this.moving.add(view);
    if (ownerChanged && this.flashes) {
      view.flashed = now;
      this.flashing.add(view);
    }
    if (view.region !== body.region || view.asleep !== body.state.asleep) this.#colour(view, now);
    this.dirty = true;
  }

  lost(body) {
    const view = this.views.get(body.id);
    if (view === undefined) return;
    view.pieces.forEach((piece, i) => this.instances.get(piece.key).remove(view.holders[i]));
    this.views.delete(body.id);
    this.moving.delete(view);
    this.flashing.delete(view);
    this.dirty = true;
  }

  select(id) {
    const before = this.selected;
    this.selected = id;
    for (const one of [before, id]) {
      const view = one === null ? undefined : this.views.get(one);
      if (view !== undefined) this.#colour(view, performance.now());
    }
    this.dirty = true;
  }

  // Shows all at this tick. True when something looks different than before.
  update(tick, now) {
    const moved = this.dirty || this.moving.size > 0 || this.flashing.size > 0;
    for (const view of this.moving) {
      const rests = poseAt(view.body, tick, view.pose);
      this.#place(view);
      if (rests) this.moving.delete(view);
    }
    for (const view of this.flashing) {
      if (now - view.flashed >= flashMs) {
        view.flashed = 0;
        this.flashing.delete(view);
      }
      this.#colour(view, now);
    }
    this.dirty = false;
    return moved;
  }

  // Before each picture; see Instances.pack.
  pack(planes, eye, fineWithin) {
    for (const instances of this.instances.values()) instances.pack(planes, eye, fineWithin);
  }

  // Time went back: what rested may not have rested then.
  unsettle() {
    for (const view of this.views.values()) this.moving.add(view);
  }

  // As drawn: red, green, blue.
  colourOf(id) {
    const view = this.views.get(id);
    if (view === undefined || view.pieces.length === 0) return null;
    return this.instances.get(view.pieces[0].key).colour(view.holders[0].place);
  }

  #add(body, look) {
    let pieces = this.lookPieces.get(look);
    if (pieces === undefined) this.lookPieces.set(look, (pieces = look ? piecesOf(look.shape) : piecesOf(unknownShape)));
    const view = {
      body, look, pieces, reach: reachOf(pieces), pose: [0, 0, 0, 0, 0, 0, 1], holders: pieces.map(() => ({ place: -1 })),
      region: -2, asleep: false, flashed: 0, simple: pieces.length === 1 && !look?.shape?.compound,
    };
    pieces.forEach((piece, i) => this.#instancesOf(piece).add(view.holders[i], piece.radius));
    this.views.set(body.id, view);
    poseAt(body, body.tick, view.pose);
    this.#place(view);
    return view;
  }

  #instancesOf(piece) {
    let instances = this.instances.get(piece.key);
    if (instances === undefined) {
      const geometries = isRound(piece) ? [geometryOf(piece), geometryOf(piece, false)] : [geometryOf(piece)];
      instances = new Instances(geometries.map((geometry) => this.#level(geometry)));
      this.instances.set(piece.key, instances);
    }
    return instances;
  }

  #level(geometry) {
    return this.software ? new MergedLevel(this.scene, geometry) : new InstancedLevel(this.scene, geometry, this.material);
  }

  #place(view) {
    const [x, y, z, qx, qy, qz, qw] = view.pose;
    for (let i = 0; i < view.pieces.length; ++i) {
      const piece = view.pieces[i], p = piece.position, o = piece.orientation;
      const instances = this.instances.get(piece.key), place = view.holders[i].place;
      if (view.simple) {
        instances.setPose(place, x, y, z, qx, qy, qz, qw, piece.scale);
        continue;
      }
      const r = rotate([qx, qy, qz, qw], p);
      instances.setPose(place, x + r[0], y + r[1], z + r[2],
        qw * o[0] + qx * o[3] + qy * o[2] - qz * o[1],
        qw * o[1] - qx * o[2] + qy * o[3] + qz * o[0],
        qw * o[2] + qx * o[1] - qy * o[0] + qz * o[3],
        qw * o[3] - qx * o[0] - qy * o[1] - qz * o[2], piece.scale);
    }
  }

  #colour(view, now) {
    view.region = view.body.region;
    view.asleep = view.body.state.asleep;
    const flash = view.flashed === 0 ? 0 : Math.max(0, 1 - (now - view.flashed) / flashMs);
    const colour = view.body.id === this.selected ? highlight : bodyColour(view.region, view.asleep, flash);
    view.pieces.forEach((piece, i) => this.instances.get(piece.key).setColour(view.holders[i].place, colour));
  }
}

// Until it is known how a body looks.
const unknownShape = { sphere: { radius: 0.25 } };
