/** Viewpoint: the camera, what turns it, and how it goes along with a garment. */
import * as three from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

export type Up = "y" | "z";

const MARGIN = 1.25; // radius of the view over the garment's
const ZONE = 0.25; // of the garment's radius: how far its centre moves before the view goes along

export class Viewpoint {
  readonly camera = new three.PerspectiveCamera(38, 1, 0.01, 100);
  up: Up = "y";
  /** Called after each turn or motion. */
  onChange: () => void = () => undefined;
  /** The same, but for copies of another viewpoint. */
  onMove: () => void = () => undefined;

  private readonly controls: OrbitControls;
  private readonly about = new three.Vector3(); // centre of the garment that is looked at
  private following = true;
  private copying = false;

  constructor(canvas: HTMLCanvasElement) {
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => {
      this.onChange();
      if (!this.copying) this.onMove();
    });
  }

  close(): void {
    this.controls.dispose();
  }

  /** The point that the camera turns about. */
  get target(): three.Vector3 {
    return this.controls.target;
  }

  get upward(): three.Vector3 {
    return this.up === "y" ? new three.Vector3(0, 1, 0) : new three.Vector3(0, 0, 1);
  }

  /** Whether it goes along with the garment. */
  get follows(): boolean {
    return this.following;
  }

  /** Looks at the whole of a garment from the side of its sensor, undefined: from its front. */
  lookAt(garment: three.Sphere, sensor: [number, number, number] | undefined): void {
    const direction = sensor ? new three.Vector3(...sensor).sub(garment.center) : new three.Vector3(0, 0, 1);
    const upward = this.upward;
    direction.addScaledVector(upward, -direction.dot(upward));
    if (direction.lengthSq() < 1e-6) direction.set(1, 0, 0);
    direction.normalize().applyAxisAngle(upward, 0.45).addScaledVector(upward, 0.18).normalize();
    const distance = (MARGIN * garment.radius) / Math.sin((Math.PI / 360) * this.camera.fov * Math.min(1, this.camera.aspect));
    this.camera.up.copy(upward);
    this.camera.position.copy(garment.center).addScaledVector(direction, distance);
    this.target.copy(garment.center);
    this.about.copy(garment.center);
    this.controls.update();
  }

  /** Moves along with a garment, without a turn; small motions are seen as they are. */
  follow(garment: three.Sphere): void {
    const away = garment.center.clone().sub(this.about);
    const beyond = away.length() - ZONE * garment.radius;
    if (!this.following || !(beyond > 0)) return;
    away.setLength(beyond);
    for (const point of [this.about, this.camera.position, this.target]) point.add(away);
    this.controls.update();
  }

  /** Follows from now on where the garment is, or no longer. */
  setFollowing(follows: boolean, garment: three.Sphere): void {
    this.following = follows;
    this.about.copy(garment.center);
  }

  /** Looks from where another one does. */
  lookAs(other: Viewpoint): void {
    this.copying = true;
    this.camera.position.copy(other.camera.position);
    this.camera.up.copy(other.camera.up);
    this.target.copy(other.target);
    this.about.copy(other.about);
    this.controls.update();
    this.copying = false;
    this.onChange();
  }

  /** Turns (radians) and moves (factor of the distance) the camera about its target. */
  orbit(azimuth: number, elevation: number, distance: number): void {
    const offset = this.camera.position.clone().sub(this.target);
    const turned = new three.Quaternion().setFromUnitVectors(this.upward, new three.Vector3(0, 1, 0));
    const spherical = new three.Spherical().setFromVector3(offset.applyQuaternion(turned));
    spherical.theta += azimuth;
    spherical.phi = Math.min(Math.PI - 0.05, Math.max(0.05, spherical.phi + elevation));
    spherical.radius *= distance;
    offset.setFromSpherical(spherical).applyQuaternion(turned.invert());
    this.camera.position.copy(this.target).add(offset);
    this.controls.update();
    this.onChange();
  }
}
