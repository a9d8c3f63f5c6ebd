// A drone's surroundings for the 3-D view: room, solids, gates, markers, safety box, no-fly zones. World axes.

import {
  BackSide,
  BoxGeometry,
  BufferGeometry,
  Color,
  CylinderGeometry,
  DoubleSide,
  EdgesGeometry,
  Float32BufferAttribute,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
  MeshLambertMaterial,
  PlaneGeometry,
  RingGeometry,
} from "three";
import { colour } from "./dom.js";
import type { Vector } from "./model.js";
import type { CameraView, World } from "./surroundings.js";

const OPEN_M = 20; // extent drawn for a missing wall of the safety box
const SEEN_M = 1.2; // drawn length of a camera's field of view

/** Everything that is fixed. */
export function scenery(world: World): Group {
  const group = new Group();
  if (world.room) group.add(...room(world.room.low, world.room.high, world.room.enclosed));
  const wood = lambert("muted", 1);
  for (const { position, size, yaw } of world.solids) group.add(upright(new BoxGeometry(...size), wood, position, yaw), edges(new BoxGeometry(...size), "line", position, yaw));
  for (const gate of world.gates) group.add(frame(gate));
  for (const { position, size, yaw, elevation } of world.markers) {
    const card = new Mesh(new BoxGeometry(0.012, size, size), lambert("text", 1));
    card.position.set(...position);
    card.rotation.set(0, -elevation, yaw, "ZYX");
    group.add(card);
  }
  for (const { position } of world.starts) group.add(ring(position, "muted"));
  for (const zone of world.zones) {
    if (zone.kind === "box") group.add(...between(zone.low, zone.high, "bad"));
    else {
      const height = zone.high - zone.low;
      const shape = new CylinderGeometry(zone.radius, zone.radius, height, 40);
      shape.rotateX(Math.PI / 2);
      const centre: Vector = [zone.centre[0], zone.centre[1], zone.low + height / 2];
      group.add(upright(shape, glass("bad"), centre, 0), edges(shape, "bad", centre, 0));
    }
  }
  if (world.box) {
    const wall = (value: number | null, otherwise: number): number => value ?? otherwise;
    const { low, high } = world.box;
    const from: Vector = [wall(low[0], -OPEN_M), wall(low[1], -OPEN_M), wall(low[2], 0)];
    const to: Vector = [wall(high[0], OPEN_M), wall(high[1], OPEN_M), wall(high[2], OPEN_M)];
    const size = to.map((value, axis) => value - (from[axis] as number)) as Vector;
    const middle = to.map((value, axis) => (value + (from[axis] as number)) / 2) as Vector;
    if (size.every((extent) => extent > 0)) group.add(edges(new BoxGeometry(...size), "ok", middle, 0));
  }
  return group;
}

/** A camera's field of view, in the axes of the body that carries it. */
export function frustum({ position, rays }: CameraView): LineSegments | null {
  if (!rays) return null;
  const eye: Vector = position ?? [0, 0, 0];
  const ends = rays.map((ray) => ray.map((part, axis) => (eye[axis] as number) + part * SEEN_M) as Vector);
  const lines = ends.flatMap((end, number) => [eye, end, end, ends[(number + 1) % ends.length] as Vector]);
  const shape = new BufferGeometry();
  shape.setAttribute("position", new Float32BufferAttribute(lines.flat(), 3));
  return new LineSegments(shape, new LineBasicMaterial({ color: new Color(colour("accent")), transparent: true, opacity: 0.6 }));
}

/** Release a group's resources on the graphics card. */
export function discard(group: Group): void {
  group.traverse((one) => {
    if (!(one instanceof Mesh) && !(one instanceof LineSegments)) return;
    (one.geometry as BufferGeometry).dispose();
    for (const material of Array.isArray(one.material) ? one.material : [one.material]) material.dispose();
  });
}

const lambert = (ink: string, opacity: number): MeshLambertMaterial => new MeshLambertMaterial({ color: new Color(colour(ink)), transparent: opacity < 1, opacity });

const glass = (ink: string): MeshBasicMaterial => new MeshBasicMaterial({ color: new Color(colour(ink)), transparent: true, opacity: 0.16, depthWrite: false, side: DoubleSide });

function upright(shape: BufferGeometry, material: MeshLambertMaterial | MeshBasicMaterial, position: Vector, yaw: number): Mesh {
  const mesh = new Mesh(shape, material);
  mesh.position.set(...position);
  mesh.rotation.z = yaw;
  return mesh;
}

function edges(shape: BufferGeometry, ink: string, position: Vector, yaw: number): LineSegments {
  const lines = new LineSegments(new EdgesGeometry(shape), new LineBasicMaterial({ color: new Color(colour(ink)) }));
  lines.position.set(...position);
  lines.rotation.z = yaw;
  return lines;
}

function between(low: Vector, high: Vector, ink: string): (Mesh | LineSegments)[] {
  const size = high.map((value, axis) => value - (low[axis] as number)) as Vector;
  const middle = high.map((value, axis) => (value + (low[axis] as number)) / 2) as Vector;
  return [upright(new BoxGeometry(...size), glass(ink), middle, 0), edges(new BoxGeometry(...size), ink, middle, 0)];
}

/** Floor and walls, visible from inside and transparent from outside. */
function room(low: Vector, high: Vector, enclosed: boolean): (Mesh | LineSegments)[] {
  const [x, y, z] = high.map((value, axis) => value - (low[axis] as number)) as Vector;
  const middle: Vector = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2];
  const floor = upright(new PlaneGeometry(x, y), lambert("raised", 1), [middle[0], middle[1], low[2] - 0.01], 0);
  const lines = edges(new BoxGeometry(x, y, z), "line", middle, 0);
  if (!enclosed) return [floor, lines];
  const walls = new MeshBasicMaterial({ color: new Color(colour("muted")), transparent: true, opacity: 0.12, side: BackSide, depthWrite: false });
  return [floor, lines, upright(new BoxGeometry(x, y, z), walls, middle, 0)];
}

function frame({ position, size, yaw, frame: bar }: World["gates"][number]): Group {
  const group = new Group();
  const [width, height] = size;
  const material = lambert("warn", 1);
  const add = (left: number, up: number, across: number, high: number): void => {
    const mesh = new Mesh(new BoxGeometry(bar, across, high), material);
    mesh.position.set(0, left, up);
    group.add(mesh);
  };
  const side = (width + bar) / 2;
  add(0, (height + bar) / 2, width + 2 * bar, bar);
  add(0, -(height + bar) / 2, width + 2 * bar, bar);
  const leg = Math.max(0, position[2] - height / 2 - bar); // it stands on the floor
  for (const left of [side, -side]) {
    add(left, 0, bar, height);
    if (leg > 0.01) add(left, -height / 2 - bar - leg / 2, bar, leg);
  }
  group.position.set(...position);
  group.rotation.z = yaw;
  return group;
}

/** A drone's start, on the ground. */
export function ring([x, y, z]: Vector, ink: string): Mesh {
  const mesh = new Mesh(new RingGeometry(0.2, 0.25, 40), new MeshBasicMaterial({ color: new Color(colour(ink)), side: DoubleSide }));
  mesh.position.set(x, y, z + 0.005);
  return mesh;
}
