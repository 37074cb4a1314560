import assert from 'node:assert/strict';
import fs from 'node:fs';
import http from 'node:http';
import os from 'node:os';
import path from 'node:path';
import { after, describe, test } from 'node:test';
import WebSocket from 'ws';
import { fileIn, listRecordings, recordingIn } from '../gateway/files.js';
import { BadFlags, parseFlags } from '../gateway/flags.js';
import { startGateway } from '../gateway/gateway.js';
import { hostCheck, sameOrigin } from '../gateway/origin.js';
import { BadRequest, pushOf, removalOf, spawnOf } from '../gateway/requests.js';
import { LiveClock } from '../src/clock.js';
import { ReplicaDecoder, moved, removed } from '../src/decode.js';
import { ReplicaMerger } from '../src/merge.js';
import { Model } from '../src/model.js';
import { scriptedPose } from '../src/mover.js';
import { bodyColour, regionColour } from '../src/palette.js';
import { pickBody } from '../src/pick.js';
import { Player } from '../src/player.js';
import { poseAt } from '../src/pose.js';
import { piecesOf, reachOf } from '../src/shapes.js';
import { cellOf, differences, encode, frameOf, messages, root, sphereOf, told } from './frames.js';

const live = 2n ** 61n;  // the first id of a spawned body
const close = (a, b, slack = 1e-3) => b.forEach((v, i) => assert.ok(Math.abs(v - a[i]) <= slack, `${a} is not ${b}`));

describe('the reader of messages', () => {
  test('IdsOf64BitsAreExact', () => {
    const ids = [1n, live, live + 1n, 2n ** 64n - 1n];
    const description = told('ReplicaFrame', { described: [sphereOf(ids)] }).described[0];
    let id = 0n;
    assert.deepEqual(description.body.map((step) => (id += step)), ids);
    assert.equal(told('FixedBody', { body: String(2n ** 64n - 1n) }).body, 2n ** 64n - 1n);
  });
  test('NegativeNumbersAndDefaultsAreReadAsTheyWereWritten', () => {
    const frame = told('ReplicaFrame', { dropped: [-1, 5, -2147483648, 2147483647], real_time_factor: 0.5 });
    assert.deepEqual(frame.dropped, [-1, 5, -2147483648, 2147483647]);
    assert.deepEqual([frame.tick, frame.more, frame.real_time_factor, frame.cells.length], [0, false, 0.5, 0]);
    assert.equal(told('GetWorldResponse', { tick: -7 }).tick, -7);
    assert.equal(told('RegionRect', { min_x: -Infinity }).min_x, -Infinity);
    assert.equal(told('PlayResponse', {}).frame, null);
  });
  test('CutMessagesAreRefused', () => {
    const bytes = encode('ReplicaFrame', { tick: 300, cells: [cellOf(1, 2, [{ id: 7, at: [1, 2, 3] }])] });
    const whole = messages.decode('ReplicaFrame', bytes);
    assert.equal(whole.cells.length, 1);
    let refused = 0;
    for (let n = 1; n < bytes.length; ++n) {
      try {
        messages.decode('ReplicaFrame', bytes.subarray(0, n));
      } catch {
        ++refused;
      }
    }
    assert.ok(refused >= bytes.length - 5, `${refused} of ${bytes.length}`);
  });
  test('UnknownFieldsAreLeftOut', () => {
    const unknown = [0xfa, 0x3e, 2, 1, 2, 0xf0, 0x3e, 5, 0xf9, 0x3e, 0, 0, 0, 0, 0, 0, 0, 0];
    const bytes = new Uint8Array([...unknown, ...encode('ReplicaFrame', { tick: 9 })]);
    assert.equal(messages.decode('ReplicaFrame', bytes).tick, 9);
  });
});

describe('the decoder', () => {
  test('NewBodiesAreWhereTheirCellIs', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(10, 0, [cellOf(-1, 2, [{ id: live, epoch: 3, at: [4, 5, 6] }])]));
    const state = decoder.get(live);
    close(state.position, [-28, 5, 70]);
    close(state.orientation, [0, 0, 0, 1]);
    assert.deepEqual([state.epoch, state.asleep, state.velocity], [3, false, null]);
  });
  test('DifferencesAddUp', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(10, 0, [cellOf(0, 0, [{ id: 4, at: [1, 1, 1] }, { id: live, at: [2, 2, 2] }])]));
    const cell = { x: 0, z: 0, id: differences([live]), position: [2048, -1024, 0], orientation: [2048, 0, 0] };
    decoder.apply(frameOf(12, 10, [cell]));
    close(decoder.get(live).position, [3, 1.5, 2]);
    close(decoder.get(live).orientation, [0.5, 0, 0, Math.sqrt(0.75)]);
    close(decoder.get(4n).position, [1, 1, 1]);
    assert.deepEqual(decoder.changed, [live]);
  });
  test('BitsAreReadLikeColumns', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(1, 0, [cellOf(0, 0, [{ id: 1, at: [0, 0, 0] }, { id: 2, at: [0, 0, 0] }])]));
    // Body 1 unchanged; body 2: position code 1 (4 bits each) of 3, -2, 0, orientation code 0.
    const bits = [0, 1, 1, 0, 0, 1, 1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0];
    const bytes = [];
    bits.forEach((bit, i) => (bytes[i >> 3] = (bytes[i >> 3] ?? 0) | (bit << (i & 7))));
    while (bytes.at(-1) === 0) bytes.pop();
    decoder.apply(frameOf(2, 1, [{ x: 0, z: 0, bits: Buffer.from(bytes) }]));
    close(decoder.get(2n).position, [3 / 2048, -2 / 2048, 0], 1e-9);
    assert.deepEqual(decoder.changed, [2n]);
  });
  test('ExactNumbersAreTaken', () => {
    const decoder = new ReplicaDecoder();
    const exact = [1.25, 2.5, 3.75, 0, 0, 1, 0, 4, 5, 6, 7, 8, 9];
    decoder.apply(frameOf(1, 0, [{ x: 0, z: 0, new_id: [5], new_epoch: [1], exact }]));
    const state = decoder.get(5n);
    assert.deepEqual([state.position, state.orientation], [exact.slice(0, 3), exact.slice(3, 7)]);
    assert.deepEqual([state.velocity, state.spin], [exact.slice(7, 10), exact.slice(10, 13)]);
  });
  test('SleepAndWakeAreTold', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(1, 0, [cellOf(0, 0, [{ id: 5, at: [0, 0, 0] }], { slept: [5] })]));
    assert.equal(decoder.get(5n).asleep, true);
    decoder.apply(frameOf(2, 1, [{ x: 0, z: 0, woke: [5] }]));
    assert.equal(decoder.get(5n).asleep, false);
  });
  test('ABodyThatChangesItsCellIsNotLost', () => {
    for (const order of [0, 1]) {
      const decoder = new ReplicaDecoder();
      decoder.apply(frameOf(1, 0, [cellOf(0, 0, [{ id: 5, at: [31, 0, 0] }])]));
      const cells = [{ x: 0, z: 0, gone: [5], why: [0] }, cellOf(1, 0, [{ id: 5, at: [0.5, 0, 0] }])];
      decoder.apply(frameOf(2, 1, order === 0 ? cells : cells.reverse()));
      assert.deepEqual(decoder.lost, []);
      close(decoder.get(5n).position, [32.5, 0, 0]);
    }
  });
  test('ADroppedCellLosesItsBodies', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(1, 0, [cellOf(0, 0, [{ id: 5, at: [0, 0, 0] }]), cellOf(1, 0, [{ id: 6, at: [0, 0, 0] }])]));
    decoder.apply(frameOf(2, 1, [], { dropped: [0, 0] }));
    assert.deepEqual(decoder.lost.map((l) => l.id), [5n]);
    assert.deepEqual([decoder.has(5n), decoder.has(6n)], [false, true]);
  });
  test('FramesThatDoNotFollowAreRefused', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(10, 0, []));
    assert.throws(() => decoder.apply(frameOf(14, 12, [])), /a frame after tick 12 where tick 10 was the last/);
    assert.throws(() => decoder.apply(frameOf(10, 10, [])), /a frame of tick 10 after tick 10/);
    const cell = { x: 0, z: 0, id: [5], position: [1, 1, 1], orientation: [0, 0, 0] };
    assert.throws(() => decoder.apply(frameOf(12, 10, [cell])), /cell 0,0 of tick 12: a difference for a body that is not there/);
  });
  test('PassedBodiesAreToldLikeMovedOnes', () => {
    const decoder = new ReplicaDecoder();
    decoder.apply(frameOf(20, 0, [], { passed: [9], passed_region: [2], passed_epoch: [4], passed_tick: [-1] }));
    assert.deepEqual(decoder.lost, [{ id: 9n, why: moved, region: 2, epoch: 4, tick: 19 }]);
  });
});

// Two regions that hand over body 7: region 0 has it with epoch 0, region 1 with epoch 1 from tick 12 on.
function handOver() {
  const merger = new ReplicaMerger();
  merger.follow(0, [0, 1]);
  const streams = [new ReplicaDecoder(), new ReplicaDecoder()];
  const take = (region, frame) => {
    if (frame.base_tick === 0) streams[region] = new ReplicaDecoder();
    streams[region].apply(frame);
    merger.apply(region, streams[region], frame);
  };
  take(0, frameOf(10, 0, [cellOf(0, 0, [{ id: 7, epoch: 0, at: [1, 0, 0] }])]));
  take(1, frameOf(10, 0, []));
  const leaves = () => take(0, frameOf(12, 10, [{ x: 0, z: 0, gone: [7], why: [3], moved_epoch: [1], moved_tick: [0] }]));
  const comes = () => take(1, frameOf(12, 10, [cellOf(0, 0, [{ id: 7, epoch: 1, at: [2, 0, 0] }])]));
  return { merger, take, leaves, comes, regionOf: () => merger.bodies.get(7n)?.region };
}

describe('the merger', () => {
  test('ABodyThatChangesItsOwnerIsAlwaysThereOnce', () => {
    for (const order of [['leaves', 'comes'], ['comes', 'leaves']]) {
      const world = handOver();
      for (const step of order) {
        world[step]();
        assert.equal(world.merger.bodies.size, 1, order.join());
        assert.deepEqual(world.merger.lost, []);
      }
      assert.equal(world.regionOf(), 1);
      close(world.merger.bodies.get(7n).state.position, [2, 0, 0]);
      assert.equal(world.merger.transits.size, 0);
    }
  });
  test('UntilTheNewOwnerTellsItTheBodyStaysAsItWas', () => {
    const world = handOver();
    world.leaves();
    assert.equal(world.regionOf(), 0);
    world.take(1, frameOf(11, 10, []));
    assert.equal(world.regionOf(), 0);
  });
  test('ABodyThatTheNewOwnerDoesNotHaveIsGone', () => {
    const world = handOver();
    world.leaves();
    world.take(1, frameOf(12, 10, []));
    assert.equal(world.merger.bodies.size, 0);
    assert.deepEqual(world.merger.lost.map((b) => b.id), [7n]);
  });
  test('ALateWordOfAFormerOwnerCountsForNothing', () => {
    const world = handOver();
    world.comes();
    world.take(0, frameOf(11, 10, [{ x: 0, z: 0, id: [7], position: [9999, 0, 0], orientation: [0, 0, 0] }]));
    assert.equal(world.regionOf(), 1);
    close(world.merger.bodies.get(7n).state.position, [2, 0, 0]);
  });
  test('RemovedBodiesAreLost', () => {
    const world = handOver();
    world.take(0, frameOf(12, 10, [{ x: 0, z: 0, gone: [7], why: [removed] }]));
    assert.deepEqual(world.merger.lost.map((b) => b.id), [7n]);
  });
  test('LateWordOfAFormerOwnerDoesNotBringARemovedBodyBack', () => {
    const world = handOver();
    world.comes();
    world.take(1, frameOf(13, 12, [{ x: 0, z: 0, gone: [7], why: [removed] }]));
    assert.equal(world.merger.bodies.size, 0);
    world.take(0, frameOf(11, 10, [{ x: 0, z: 0, id: [7], position: [9999, 0, 0], orientation: [0, 0, 0] }]));
    assert.equal(world.merger.bodies.size, 0);
  });
  test('WhatANewStreamDoesNotTellIsGoneWhenNobodyElseTellsIt', () => {
    const world = handOver();
    world.take(0, frameOf(20, 0, []));
    assert.equal(world.merger.bodies.size, 1, 'region 1 may have it by tick 20');
    world.take(1, frameOf(20, 10, []));
    assert.equal(world.merger.bodies.size, 0);
  });
  test('BodiesOfARegionThatLeavesStayUntilAnotherTellsThem', () => {
    const world = handOver();
    world.merger.follow(1, [1, 2]);
    const of = { layout_epoch: 1 };
    world.take(1, frameOf(12, 10, []));
    world.take(2, frameOf(12, 0, []));
    world.take(1, frameOf(14, 12, [], of));
    assert.equal(world.merger.bodies.size, 1, 'region 2 has told nothing of this layout');
    world.take(2, frameOf(13, 12, [], of));
    assert.equal(world.merger.bodies.size, 1, 'nor what it has at tick 14');
    world.take(2, frameOf(14, 13, [cellOf(0, 0, [{ id: 7, epoch: 1, at: [2, 0, 0] }])], of));
    assert.equal(world.regionOf(), 2);
    world.take(1, frameOf(20, 14, [], of));
    world.take(2, frameOf(20, 14, [], of));
    assert.equal(world.merger.bodies.size, 1);
  });
  test('ABodyOfARegionThatHasLeftWhichNobodyHasIsGone', () => {
    const world = handOver();
    world.merger.follow(1, [1]);
    world.take(1, frameOf(12, 10, []));
    assert.equal(world.merger.bodies.size, 1);
    world.take(1, frameOf(14, 12, [], { layout_epoch: 1 }));
    assert.equal(world.merger.bodies.size, 0);
    assert.deepEqual(world.merger.lost.map((b) => b.id), [7n]);
  });
  test('ABodyThatWentOnBeforeItsNewOwnersStreamBeganStaysUntilAThirdTellsIt', () => {
    const world = handOver();
    world.merger.follow(0, [0, 1, 2]);
    world.leaves();
    world.take(1, frameOf(14, 0, []));  // begun anew: it gave the body to region 2 at tick 13
    world.take(0, frameOf(14, 12, []));
    assert.equal(world.merger.bodies.size, 1);
    world.take(2, frameOf(14, 0, [cellOf(0, 0, [{ id: 7, epoch: 2, at: [2, 0, 0] }])]));
    assert.equal(world.regionOf(), 2);
  });
  test('ABodyAtRestIsShownAtRestUntilItWasToldToMove', () => {
    const world = handOver();
    world.take(0, frameOf(20, 10, []));
    world.take(0, frameOf(22, 20, [{ x: 0, z: 0, id: [7], position: [2048, 0, 0], orientation: [0, 0, 0] }]));
    const pose = [];
    assert.equal(poseAt(world.merger.bodies.get(7n), 19, pose), false);
    close(pose, [1, 0, 0]);
    poseAt(world.merger.bodies.get(7n), 21, pose);
    close(pose, [1.5, 0, 0]);
    assert.equal(poseAt(world.merger.bodies.get(7n), 22, pose), true);
    close(pose, [2, 0, 0]);
  });
});

describe('the clock', () => {
  test('ItGoesEvenlyAndNeverBack', () => {
    const clock = new LiveClock();
    const options = { tickSeconds: 0.016, factor: 1, period: 3 };
    let before = 0, most = 0;
    for (let ms = 0, tick = 100; ms < 5000; ms += 16) {
      // Frames of three ticks come in bursts of two.
      if (ms % 96 === 0) clock.take((tick += 6), ms);
      const now = clock.advance(ms, options);
      if (ms > 1000) most = Math.max(most, now - before);
      assert.ok(now >= before);
      before = now;
    }
    assert.ok(most > 0.5 && most < 1.6, `${most}`);
    assert.ok(Math.abs(clock.newest - before) < 14);
  });
  test('ItStopsWhenNoFramesCome', () => {
    const clock = new LiveClock();
    clock.take(100, 0);
    for (let ms = 0; ms < 3000; ms += 16) clock.advance(ms, { tickSeconds: 0.016, factor: 1, period: 3 });
    assert.ok(clock.tick > 99 && clock.tick <= 100);
  });
});

describe('picking', () => {
  const bodyOf = (shape, pose = [0, 0, 0, 0, 0, 0, 1]) => {
    const pieces = piecesOf(told('FixedBody', { shape }).shape);
    return { pose, pieces, reach: reachOf(pieces) };
  };
  const distance = (body, origin, direction) => pickBody([body], origin, direction)?.distance ?? null;
  const half = Math.SQRT1_2;

  test('EachShapeIsHitWhereItIs', () => {
    assert.equal(distance(bodyOf({ sphere: { radius: 1 } }), [0, 0, 5], [0, 0, -1]), 4);
    assert.equal(distance(bodyOf({ sphere: { radius: 1 } }), [0, 1.1, 5], [0, 0, -1]), null);
    assert.equal(distance(bodyOf({ box: { size: { x: 2, y: 2, z: 6 } } }), [0, 0.9, 5], [0, 0, -1]), 2);
    assert.equal(distance(bodyOf({ box: { size: { x: 2, y: 2, z: 6 } } }), [0, 1.1, 5], [0, 0, -1]), null);
    assert.equal(distance(bodyOf({ cylinder: { radius: 1, height: 4 } }), [0, 1.9, 5], [0, 0, -1]), 4);
    assert.equal(distance(bodyOf({ cylinder: { radius: 1, height: 4 } }), [0, 2.1, 5], [0, 0, -1]), null);
    assert.equal(distance(bodyOf({ cylinder: { radius: 1, height: 4 } }), [0, 5, 0], [0, -1, 0]), 3);
    assert.equal(distance(bodyOf({ capsule: { radius: 1, height: 4 } }), [0, 5, 0], [0, -1, 0]), 3);
    assert.equal(distance(bodyOf({ capsule: { radius: 1, height: 4 } }), [0, 0.5, 5], [0, 0, -1]), 4);
    assert.equal(distance(bodyOf({ capsule: { radius: 1, height: 4 } }), [0.9, 1.9, 5], [0, 0, -1]), null);
  });
  test('HullsAndCompoundsAreHitWhereTheyAre', () => {
    const points = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]].map(([x, y, z]) => ({ x, y, z }));
    close([distance(bodyOf({ hull: { points } }), [0, 0.4, 5], [0, 0, -1])], [4.4]);
    assert.equal(distance(bodyOf({ hull: { points } }), [0.6, 0.6, 5], [0, 0, -1]), null);
    const compound = { compound: { children: [{ position: { x: 3 }, shape: { sphere: { radius: 0.5 } } }] } };
    assert.equal(distance(bodyOf(compound), [3, 0, 5], [0, 0, -1]), 4.5);
    assert.equal(distance(bodyOf(compound), [0, 0, 5], [0, 0, -1]), null);
  });
  test('ATurnedBodyIsHitWhereItIsAndSaysWhere', () => {
    // A quarter turn about z: what was along x is along y.
    const body = bodyOf({ box: { size: { x: 4, y: 1, z: 1 } } }, [10, 0, 0, 0, 0, half, half]);
    const hit = pickBody([body], [10, 1.8, 5], [0, 0, -1]);
    close([hit.distance], [4.5]);
    close(hit.point, [1.8, 0, 0.5]);
    assert.equal(distance(body, [11.8, 0, 5], [0, 0, -1]), null);
  });
  test('TheNearestBodyIsPicked', () => {
    const near = bodyOf({ sphere: { radius: 1 } }, [0, 0, 2, 0, 0, 0, 1]);
    const far = bodyOf({ sphere: { radius: 2 } }, [0, 0, -3, 0, 0, 0, 1]);
    for (const bodies of [[near, far], [far, near]]) assert.equal(pickBody(bodies, [0, 0, 9], [0, 0, -1]).body, near);
  });
});

describe('scripts and colours', () => {
  test('AMoverFollowsItsKeysAndRepeats', () => {
    const keys = [
      { time: 0, position: [0, 0, 0], orientation: [0, 0, 0, 1] },
      { time: 2, position: [4, 0, 0], orientation: [0, 1, 0, 0] },
    ];
    close(scriptedPose(keys, 0, 0.5).position, [1, 0, 0]);
    close(scriptedPose(keys, 0, 9).position, [4, 0, 0]);
    close(scriptedPose(keys, 2, 5).position, [2, 0, 0]);
    close(scriptedPose(keys, 2, 5).orientation, [0, Math.SQRT1_2, 0, Math.SQRT1_2]);
  });
  test('RegionsHaveDifferentColoursAndSleepersAreDarker', () => {
    const colours = new Set(Array.from({ length: 16 }, (_, region) => regionColour(region).join()));
    assert.equal(colours.size, 16);
    assert.ok(bodyColour(2, true)[1] < 0.5 * bodyColour(2, false)[1]);
    close(bodyColour(3, false, 1), [1, 1, 1]);
  });
});

describe('the player', () => {
  // Body 7 goes 1 m per tick along x; a frame per 2 ticks, 200 ticks.
  const recording = () => {
    const world = told('GetWorldResponse', { name: 'one', tick_us: 16000, layout: [{ min_x: -Infinity }], endpoints: ['x:1'] });
    const entries = [];
    for (let tick = 2; tick <= 200; tick += 2) {
      const cells = tick === 2 ? [cellOf(0, 0, [{ id: 7, at: [0, 0, 0] }])]
        : [{ x: 0, z: 0, id: [7], position: [4096, 0, 0], orientation: [0, 0, 0] }];
      const described = tick === 2 ? [sphereOf([7])] : [];
      entries.push({ tick, region: 0, kind: 'frame', bytes: encode('ReplicaFrame', { tick, base_tick: tick === 2 ? 0 : tick - 2, cells, described }) });
    }
    return { world, entries, firstTick: 2, lastTick: 200 };
  };
  const start = () => {
    let now = 0;
    const model = new Model({ changed() {}, lost() {}, reset() {} });
    const player = new Player(model, messages, recording(), () => now);
    const x = () => {
      const pose = [];
      poseAt(model.bodies.get(7n), player.tick, pose);
      return pose[0];
    };
    const run = (ms) => {
      for (const end = now + ms; now < end; ) player.advance((now += 16));
    };
    player.advance(now);
    return { player, model, x, run };
  };
  test('PositionsFollowTimeAndSpeed', () => {
    const { player, x, run } = start();
    close([x()], [0]);
    run(800);
    close([x()], [50], 1.1);
    player.speed = 0.25;
    run(1600);
    close([x()], [75], 2.1);
  });
  test('ScrubbingBackShowsTheFirstStateAgain', () => {
    const { player, model, x, run } = start();
    run(3000);
    assert.equal(player.playing, true);
    player.playing = false;
    for (const tick of [150.5, 2, 77, 199, 30, 2]) {
      player.seek(tick);
      run(160);
      assert.equal(player.seeking, false);
      close([x()], [tick - 2]);
      assert.equal(model.bodies.size, 1);
    }
  });
  test('ItStopsAtTheEnd', () => {
    const { player, x, run } = start();
    run(5000);
    assert.deepEqual([player.playing, player.tick], [false, 200]);
    close([x()], [198]);
  });
});

describe('the gateway', () => {
  const folder = fs.mkdtempSync(path.join(os.tmpdir(), 'aureole-viewer-'));
  const dist = path.join(folder, 'dist');
  const recordings = path.join(folder, 'recordings');
  fs.mkdirSync(dist);
  fs.mkdirSync(recordings);
  fs.writeFileSync(path.join(dist, 'index.html'), 'the page');
  fs.writeFileSync(path.join(recordings, 'a b.mcap'), 'a recording');
  fs.writeFileSync(path.join(recordings, 'notes.txt'), 'no recording');
  fs.writeFileSync(path.join(folder, 'secret.mcap'), 'secret');
  fs.symlinkSync(path.join(folder, 'secret.mcap'), path.join(recordings, 'link.mcap'));
  after(() => fs.rmSync(folder, { recursive: true }));

  const start = () => startGateway({ root, dist, server: '', listen: { host: '127.0.0.1', port: 0 }, recordings, allowedHosts: [] });
  // As it is: clients tidy paths up before they send them.
  const get = (url, target, headers = {}) => new Promise((resolve, reject) => {
    const { hostname, port } = new URL(url);
    http.get({ hostname, port, path: target, headers }, (response) => {
      let text = '';
      response.on('data', (data) => (text += data)).on('end', () => resolve({ status: response.statusCode, text, headers: response.headers }));
    }).on('error', reject);
  });
  const upgrade = (url, headers) => new Promise((resolve) => {
    const socket = new WebSocket(`${url.replace('http', 'ws')}socket`, { headers });
    socket.on('open', () => resolve('open') ?? socket.close());
    socket.on('unexpected-response', (request, response) => resolve(response.statusCode));
    socket.on('error', () => resolve('error'));
  });

  test('OnlyFilesOfTheFolderAreFound', async () => {
    assert.ok((await fileIn(dist, '/index.html')).endsWith('index.html'));
    for (const bad of ['/../secret.mcap', '/%2e%2e/secret.mcap', '/..%2fsecret.mcap', '/..\\secret.mcap', '/', '//etc/passwd', '/%00', '/%', '/.git']) {
      assert.equal(await fileIn(dist, bad), null, bad);
    }
    assert.ok((await recordingIn(recordings, 'a%20b.mcap')).endsWith('a b.mcap'));
    for (const bad of ['../secret.mcap', '..%2fsecret.mcap', '%2e%2e%2fsecret.mcap', 'notes.txt', 'link.mcap', '.mcap', '']) {
      assert.equal(await recordingIn(recordings, bad), null, bad);
    }
    assert.deepEqual(await listRecordings(recordings), [{ name: 'a b.mcap', bytes: 11 }]);
    assert.deepEqual(await listRecordings(path.join(folder, 'none')), []);
  });
  test('PagesAndRecordingsAreServed', async () => {
    const gateway = await start();
    try {
      const page = await get(gateway.url, '/');
      assert.deepEqual([page.status, page.text], [200, 'the page']);
      assert.match(page.headers['content-security-policy'], /default-src 'self'/);
      assert.equal((await get(gateway.url, '/recordings/a%20b.mcap')).text, 'a recording');
      for (const bad of ['/../secret.mcap', '/recordings/../secret.mcap', '/recordings/%2e%2e%2fsecret.mcap', '/recordings/link.mcap']) {
        assert.equal((await get(gateway.url, bad)).status, 404, bad);
      }
      assert.deepEqual(JSON.parse((await get(gateway.url, '/settings.json')).text), { live: false, recordings: [{ name: 'a b.mcap', bytes: 11 }] });
      assert.equal((await get(gateway.url, '/', { Host: 'evil.example' })).status, 403);
    } finally {
      await gateway.close();
    }
  });
  test('ForeignPagesMayNotConnect', async () => {
    const gateway = await start();
    try {
      const { host } = new URL(gateway.url);
      assert.equal(await upgrade(gateway.url, { Origin: `http://${host}` }), 'open');
      assert.equal(await upgrade(gateway.url, { Origin: 'http://evil.example' }), 403);
      assert.equal(await upgrade(gateway.url, { Origin: `http://${host}0` }), 403);
      assert.equal(await upgrade(gateway.url, { Origin: 'null' }), 403);
      assert.equal(await upgrade(gateway.url, {}), 403);
      // A name of theirs that resolves to this machine.
      assert.equal(await upgrade(gateway.url, { Origin: 'http://evil.example', Host: 'evil.example' }), 403);
    } finally {
      await gateway.close();
    }
  });
  test('HostsAreOnesOwn', () => {
    const own = hostCheck('127.0.0.1');
    for (const good of ['127.0.0.1:80', 'localhost:80', 'LOCALHOST', '[::1]:80']) assert.equal(own(good), true, good);
    for (const bad of ['', undefined, '192.0.2.1:80', 'evil.example', 'localhost@evil', '127.0.0.1.evil.example', '[::1']) assert.equal(own(bad), false, bad);
    const everywhere = hostCheck('0.0.0.0', ['Viewer.example']);
    for (const good of ['192.0.2.1:80', '[2001:db8::1]:80', 'viewer.example:443']) assert.equal(everywhere(good), true, good);
    assert.equal(everywhere('evil.example'), false);
    assert.equal(sameOrigin({ host: 'a:1', origin: 'https://a:1' }), true);
    assert.equal(sameOrigin({ host: 'a:1', origin: 'http://a:2' }), false);
  });
  test('BadFlagsAreRefusedWithTheirName', () => {
    assert.equal(parseFlags(['--server=127.0.0.1:4']).server, '127.0.0.1:4');
    assert.deepEqual(parseFlags(['--server', 'a:4', '--listen', '[::1]:5']).listen, { host: '::1', port: 5 });
    const cases = [
      [[], /--server: give one/], [['--server'], /--server: needs a value/], [['--server', 'x'], /--server: must be HOST:PORT/],
      [['--server', 'a:70000'], /HOST:PORT/], [['--server', 'a:1', '--listen', '1'], /--listen: must be/], [['--servr', 'a:1'], /--servr: no such flag/],
    ];
    for (const [argv, words] of cases) assert.throws(() => parseFlags(argv), (e) => e instanceof BadFlags && words.test(e.message), argv.join(' '));
  });
  test('WhatABrowserAsksForIsChecked', () => {
    assert.deepEqual(pushOf({ body: String(live), velocity_change: [1, 2, 3] }), { body: String(live), velocity_change: { x: 1, y: 2, z: 3 } });
    const bad = [
      {}, { body: 7, impulse: [1, 1, 1] }, { body: '7' }, { body: '7', impulse: [1, 1] }, { body: '7', impulse: [1, 1, null] },
      { body: '7', impulse: [1, 1, 1e300] }, { body: '-7', impulse: [1, 1, 1] }, { body: '99999999999999999999', impulse: [1, 1, 1] },
      { body: '7', velocity_change: [1, 1, 1], at_body_point: [0, 0, 0] },
    ];
    for (const message of bad) assert.throws(() => pushOf(message), BadRequest, JSON.stringify(message));
    assert.throws(() => spawnOf({ bodies: [] }), BadRequest);
    assert.throws(() => spawnOf({ bodies: [{ shape: { mesh: {} }, position: [0, 0, 0] }] }), BadRequest);
    assert.throws(() => spawnOf({ bodies: [null] }), BadRequest);
    assert.throws(() => removalOf({ bodies: 'all' }), BadRequest);
  });
});
