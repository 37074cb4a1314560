// The world of the browser test: 1,000 bodies that keep moving in a yard on four regions, 1,000 that sleep beside it, and
// nothing at the corners.

const shapes = {
  ball: { sphere: { radius: 0.35 } },
  crate: { box: { size: { x: 0.6, y: 0.6, z: 0.6 } } },
  log: { capsule: { radius: 0.25, height: 1.2 } },
  drum: { cylinder: { radius: 0.35, height: 0.7 } },
};

export const bodiesAtStart = 2000, asleepAtStart = 1000;

const quarters = [[-1, -1], [1, -1], [-1, 1], [1, 1]];

// Two blocks over each quarter of the yard, thrown at its middle.
function thrown() {
  return quarters.flatMap(([sx, sz]) => (sx === sz ? ['ball', 'drum'] : ['log', 'crate']).map((named, i) => ({
    shape: { named }, density: 300, material: 'bouncy',
    position: { x: sx * 17 - 10 + 12 * i, y: 2, z: sz * 17 - 4 },
    velocity: { x: -sx * 4, y: 5, z: -sz * 4 },
    array: { x: 5, y: 5, z: 5, spacing: { x: 1.8, y: 1.8, z: 1.8 } },
  })));
}

// Rows of crates and drums on the ground, outside of the yard.
function asleep() {
  return quarters.flatMap(([sx, sz]) => [['crate', 0.3, sx * 38, sz > 0 ? 2 : -26], ['drum', 0.35, sx * 46, sz > 0 ? 2 : -26]]
    .map(([named, y, x, z]) => ({
      shape: { named }, density: 300, asleep: true, position: { x: x - 2, y, z }, array: { x: 5, z: 25, spacing: { x: 1, z: 1 } },
    })));
}

export function testWorld() {
  return {
    name: 'viewer-test',
    layout: { grid: { x_edges: [0], z_edges: [0] } },
    materials: { bouncy: { friction: 0.2, restitution: 0.95, angular_damping: 0 } },
    shapes,
    bodies: [...thrown(), ...asleep()],
    movers: [{
      shape: { box: { size: { x: 24, y: 1, z: 0.6 } } },
      material: 'bouncy',
      period: '12s',
      keys: [0, 120, 240, 360].map((degrees, i) => ({
        time: `${4 * i}s`, position: { y: 0.6 }, turn: { axis: { y: 1 }, degrees },
      })),
    }],
    statics: [
      { shape: { plane: { normal: { y: 1 } } }, material: 'bouncy' },
      ...[[0, -30, 0], [0, 30, 0], [-30, 0, 90], [30, 0, 90]].map(([x, z, degrees]) => ({
        shape: { box: { size: { x: 61, y: 8, z: 1 } } }, position: { x, y: 4, z }, turn: { axis: { y: 1 }, degrees },
      })),
    ],
  };
}
