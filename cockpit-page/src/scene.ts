// The 3-D view. Loaded on first use. World axes: x east, y north, z up [m].

import {
  AmbientLight,
  AxesHelper,
  BufferGeometry,
  BoxGeometry,
  Color,
  ConeGeometry,
  CylinderGeometry,
  DirectionalLight,
  Float32BufferAttribute,
  GridHelper,
  Group,
  Line,
  LineBasicMaterial,
  LineDashedMaterial,
  Mesh,
  MeshLambertMaterial,
  OctahedronGeometry,
  PerspectiveCamera,
  Scene as ThreeScene,
  SphereGeometry,
  TorusGeometry,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { colour, h } from "./dom.js";
import { t } from "./language/index.js";
import { discard, frustum, ring, scenery } from "./scenery.js";
import type { Vector } from "./model.js";
import type { World } from "./surroundings.js";
import type { Body, Scene } from "./world.js";

const PERIOD_MS = 50; // interval between drawings
const POINTS = 4096; // maximum number of points of the path

const TURNS: ReadonlySet<string> = new Set(["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]);
const NEARER: Readonly<Record<string, number>> = { Equal: 0.85, NumpadAdd: 0.85, Minus: 1.18, NumpadSubtract: 1.18 };
const TURN_RAD = 0.1; // per press of a key

export class SceneView {
  readonly element = h("div", { class: "scene", role: "application", tabindex: 0, "data-keys": [...TURNS, ...Object.keys(NEARER)].join(" "), "aria-label": t.map.space });
  private readonly renderer = new WebGLRenderer({ antialias: true, alpha: true, powerPreference: "low-power" });
  private readonly scene = new ThreeScene();
  private readonly camera = new PerspectiveCamera(50, 1, 0.05, 200);
  private readonly controls: OrbitControls;
  private readonly bodies = new Map<string, Group>();
  private readonly path = new Line(new BufferGeometry(), new LineBasicMaterial());
  private readonly drop = new Line(new BufferGeometry(), new LineDashedMaterial({ dashSize: 0.08, gapSize: 0.06 }));
  private readonly legs = new Line(new BufferGeometry(), new LineBasicMaterial());
  private laid = "";
  private grid = new GridHelper();
  private drawn_ms = 0;
  private world: World | null = null;
  private around: Group | null = null;

  /** Throws without WebGL. */
  constructor(private readonly current: () => Scene) {
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-4, -5, 4);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.maxPolarAngle = Math.PI / 2 - 0.02;
    this.controls.target.set(0, 0, 1);
    this.path.geometry.setAttribute("position", new Float32BufferAttribute(POINTS * 3, 3));
    this.drop.geometry.setAttribute("position", new Float32BufferAttribute(6, 3));
    this.path.frustumCulled = this.drop.frustumCulled = this.legs.frustumCulled = false;
    const sun = new DirectionalLight(0xffffff, 2.2);
    sun.position.set(-3, -2, 8);
    this.scene.add(sun, new AmbientLight(0xffffff, 1.3), this.path, this.drop, this.legs, new AxesHelper(0.6));
    this.element.append(this.renderer.domElement);
    this.element.addEventListener("keydown", (event) => this.key(event));
    this.repaint();
  }

  /** The colours have changed. */
  repaint(): void {
    this.scene.remove(this.grid);
    this.grid = new GridHelper(20, 20, colour("line"), colour("line"));
    this.grid.rotateX(Math.PI / 2);
    this.scene.add(this.grid);
    this.path.material.color = new Color(colour("accent"));
    this.legs.material.color = new Color(colour("warn"));
    this.drop.material.color = new Color(colour("muted"));
    for (const body of this.bodies.values()) this.scene.remove(body);
    this.bodies.clear();
    this.surround(null);
  }

  draw(now_ms: number): void {
    const [width, height] = [this.element.clientWidth, this.element.clientHeight];
    if (now_ms - this.drawn_ms < PERIOD_MS || !width || !height) return;
    this.drawn_ms = now_ms;
    const density = Math.min(2, window.devicePixelRatio || 1);
    if (this.renderer.domElement.width !== Math.floor(width * density)) this.resize(width, height, density);
    else if (this.renderer.domElement.height !== Math.floor(height * density)) this.resize(width, height, density);
    this.arrange(this.current());
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }

  close(): void {
    this.controls.dispose();
    this.renderer.dispose();
  }

  private resize(width: number, height: number, density: number): void {
    this.renderer.setPixelRatio(density);
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  private arrange(scene: Scene): void {
    if ((scene.world ?? null) !== this.world) this.surround(scene.world ?? null);
    const shown = new Set<string>();
    const place = (key: string, body: Body, make: () => Group): void => {
      shown.add(key);
      let group = this.bodies.get(key);
      if (!group) {
        group = make();
        this.bodies.set(key, group);
        this.scene.add(group);
      }
      group.position.set(...body.position);
      // Rz(yaw) Ry(pitch) Rx(roll): REP 103's signs are those of right-handed turns about these axes.
      group.rotation.set(body.roll, body.pitch, body.yaw ?? 0, "ZYX");
    };
    if (scene.own) place("own", scene.own, () => this.equipped(quadrotor(colour("accent"), 1)));
    if (scene.truth) place(scene.own ? "ghost" : "truth", scene.truth, () => quadrotor(colour("ok"), scene.own ? 0.35 : 1));
    for (const other of scene.others) place(`other ${other.name}`, other, () => quadrotor(colour("muted"), 1));
    for (const target of scene.targets) place(`target ${target.name}`, target, () => solid(new OctahedronGeometry(0.14), colour("target")));
    scene.waypoints.forEach(({ position, own }, number) => {
      const body = { name: "", position, roll: 0, pitch: 0, yaw: null };
      place(`waypoint ${number} ${own}`, body, () => solid(new SphereGeometry(0.09, 16, 12), colour(own ? "accent" : "warn")));
    });
    if (scene.start) place("start", { name: "", position: scene.start, roll: 0, pitch: 0, yaw: null }, () => new Group().add(ring([0, 0, 0], "accent")));
    (scene.route ?? []).forEach((position, number) => place(`route ${number}`, { name: "", position, roll: 0, pitch: 0, yaw: null }, () => solid(new SphereGeometry(0.07, 16, 12), colour("warn"))));
    for (const [key, group] of this.bodies) {
      if (shown.has(key)) continue;
      this.scene.remove(group);
      this.bodies.delete(key);
    }
    this.lay(scene.route ?? []);
    this.trace(scene);
    const own = scene.own ?? scene.truth;
    if (own) this.follow(new Vector3(...own.position));
  }

  /** The legs of a route. */
  private lay(places: readonly Vector[]): void {
    this.legs.visible = places.length > 1;
    const key = places.join(";");
    if (key === this.laid) return;
    this.laid = key;
    this.legs.geometry.dispose();
    this.legs.geometry = new BufferGeometry().setFromPoints(places.map((place) => new Vector3(...place)));
  }

  private surround(world: World | null): void {
    this.world = world;
    if (this.around) {
      this.scene.remove(this.around);
      discard(this.around);
    }
    this.around = world && scenery(world);
    if (this.around) this.scene.add(this.around);
    const own = this.bodies.get("own"); // its cameras may have changed
    if (own) this.scene.remove(own);
    this.bodies.delete("own");
    this.grid.visible = !world?.room;
  }

  /** Including the cameras' views. */
  private equipped(body: Group): Group {
    for (const camera of this.world?.cameras ?? []) {
      const view = frustum(camera);
      if (view) body.add(view);
    }
    return body;
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const nearer = NEARER[event.code];
    if (nearer === undefined && !TURNS.has(event.code)) return;
    event.preventDefault();
    const arm = this.camera.position.clone().sub(this.controls.target);
    if (nearer !== undefined) arm.multiplyScalar(nearer);
    else if (event.code === "ArrowLeft" || event.code === "ArrowRight") arm.applyAxisAngle(this.camera.up, event.code === "ArrowLeft" ? -TURN_RAD : TURN_RAD);
    else {
      const level = new Vector3().crossVectors(this.camera.up, arm).normalize();
      const turned = arm.clone().applyAxisAngle(level, event.code === "ArrowUp" ? -TURN_RAD : TURN_RAD);
      const steep = turned.angleTo(this.camera.up);
      if (steep > 0.05 && steep < Math.PI / 2 - 0.02) arm.copy(turned);
    }
    this.camera.position.copy(this.controls.target).add(arm);
  }

  private trace(scene: Scene): void {
    const points = scene.trail.points.slice(-(POINTS - 1)).map((point) => point.place);
    const end = scene.own ?? scene.truth;
    if (end) points.push(end.position);
    const along = this.path.geometry.getAttribute("position");
    points.forEach((point, number) => along.setXYZ(number, ...point));
    along.needsUpdate = true;
    this.path.geometry.setDrawRange(0, points.length);
    this.drop.visible = end !== null;
    if (!end) return;
    const [x, y, z] = end.position;
    const down = this.drop.geometry.getAttribute("position");
    down.setXYZ(0, x, y, z);
    down.setXYZ(1, x, y, 0);
    down.needsUpdate = true;
    this.drop.computeLineDistances();
  }

  /** The eye moves with the drone; the chosen rotation and zoom are kept. */
  private follow(place: Vector3): void {
    const step = place.sub(this.controls.target).multiplyScalar(0.12);
    this.controls.target.add(step);
    this.camera.position.add(step);
  }
}

function solid(geometry: BufferGeometry, ink: string): Group {
  return new Group().add(new Mesh(geometry, new MeshLambertMaterial({ color: new Color(ink) })));
}

/** Larger than life, to be visible; its nose is the cone. */
function quadrotor(ink: string, opacity: number): Group {
  const material = new MeshLambertMaterial({ color: new Color(ink), transparent: opacity < 1, opacity });
  const group = new Group();
  group.add(new Mesh(new BoxGeometry(0.26, 0.13, 0.07), material));
  const nose = new Mesh(new ConeGeometry(0.06, 0.14, 16), material);
  nose.rotation.z = -Math.PI / 2;
  nose.position.x = 0.2;
  group.add(nose);
  for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]] as const) {
    const arm = new Mesh(new CylinderGeometry(0.015, 0.015, 0.3), material);
    arm.rotation.z = Math.atan2(y, x) - Math.PI / 2;
    arm.position.set(x * 0.1, y * 0.1, 0);
    const ring = new Mesh(new TorusGeometry(0.12, 0.014, 8, 28), material);
    ring.position.set(x * 0.2, y * 0.2, 0.03);
    group.add(arm, ring);
  }
  return group;
}
