// What a browser may ask for, checked: JSON in, objects for the interface's messages out. Throws BadRequest.

export class BadRequest extends Error {}

const mostBodies = 1024;  // in one call

function number(value, name, least = -1e9, most = 1e9) {
  if (typeof value !== 'number' || !(value >= least && value <= most)) {
    throw new BadRequest(`${name}: must be a number from ${least} to ${most}`);
  }
  return value;
}

function vector(value, name, most) {
  if (!Array.isArray(value) || value.length !== 3) throw new BadRequest(`${name}: must be three numbers`);
  const [x, y, z] = value.map((v) => number(v, name, -most, most));
  return { x, y, z };
}

function id(value, name) {
  if (typeof value !== 'string' || !/^\d{1,20}$/.test(value) || BigInt(value) >= 1n << 64n) {
    throw new BadRequest(`${name}: must be an id, as a string`);
  }
  return value;
}

// A push of one body: by an impulse, at a point of the body or at its centre, or by a change of velocity.
export function pushOf(message) {
  const out = { body: id(message.body, 'body') };
  if (message.impulse !== undefined) out.impulse = vector(message.impulse, 'impulse', 1e9);
  if (message.velocity_change !== undefined) out.velocity_change = vector(message.velocity_change, 'velocity_change', 1e4);
  if ((out.impulse === undefined) === (out.velocity_change === undefined)) {
    throw new BadRequest('impulse: give it or velocity_change');
  }
  if (message.at_body_point !== undefined) {
    if (out.impulse === undefined) throw new BadRequest('at_body_point: is for an impulse');
    out.at_body_point = vector(message.at_body_point, 'at_body_point', 1e6);
  }
  return out;
}

function shapeOf(shape) {
  if (shape?.sphere !== undefined) return { sphere: { radius: number(shape.sphere.radius, 'radius', 0.001, 1000) } };
  if (shape?.box !== undefined) return { box: { size: vector(shape.box.size, 'size', 1000) } };
  throw new BadRequest('shape: must be a sphere or a box');
}

export function spawnOf(message) {
  const bodies = message.bodies;
  if (!Array.isArray(bodies) || bodies.length < 1 || bodies.length > mostBodies) {
    throw new BadRequest(`bodies: must be 1 to ${mostBodies}`);
  }
  return {
    bodies: bodies.map((body) => ({
      shape: shapeOf(body?.shape),
      density: number(body.density ?? 500, 'density', 0.001, 1e6),
      position: vector(body.position, 'position', 1e7),
      velocity: vector(body.velocity ?? [0, 0, 0], 'velocity', 1e4),
    })),
  };
}

export function removalOf(message) {
  const bodies = message.bodies;
  if (!Array.isArray(bodies) || bodies.length < 1 || bodies.length > mostBodies) {
    throw new BadRequest(`bodies: must be 1 to ${mostBodies}`);
  }
  return { body: bodies.map((body) => id(body, 'bodies')) };
}

export function rayOf(message) {
  return {
    rays: [{
      origin: vector(message.origin, 'origin', 1e7),
      direction: vector(message.direction, 'direction', 1e7),
      length: number(message.length, 'length', 1e-6, 1e5),
    }],
  };
}
