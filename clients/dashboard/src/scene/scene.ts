/** Scene: the garment with its body and cloud, drawn when something has changed. */
import * as three from "three";
import { distancesTo, vertexNormals } from "../session/surface.js";
import type { Cloud } from "../session/cloud.js";
import type { Shape } from "../session/memory.js";
import { colour } from "../theme.js";
import { SCALES, paint, paintNormals, paintPlain, toLinear, type Mode } from "./colours.js";
import { RADIUS_90, ellipsoid90 } from "./ellipsoid.js";
import { objects, put } from "./objects.js";
import { Picker } from "./picker.js";
import { Resolution, isSoftware } from "./resolution.js";
import { Viewpoint } from "./viewpoint.js";

/** What is drawn besides the garment. */
export interface Layers {
  body: boolean;
  cloud: boolean;
  wires: boolean;
}

export class Scene {
  readonly canvas: HTMLCanvasElement;
  readonly picker: Picker;
  readonly view: Viewpoint;
  mode: Mode = "reliability";
  layers: Layers = { body: true, cloud: true, wires: false };

  private readonly renderer: three.WebGLRenderer;
  private readonly scene = new three.Scene();
  private readonly objects = objects();
  private floor = new three.GridHelper();
  private readonly resolution: Resolution;
  private shape: Shape | undefined;
  private faces: Uint32Array = new Uint32Array();
  private framed = false;
  private requested = false;
  private closed = false;
  private readonly observer: ResizeObserver;

  constructor(container: HTMLElement) {
    this.renderer = new three.WebGLRenderer({ antialias: !isSoftware(), alpha: true, powerPreference: "high-performance" });
    this.canvas = this.renderer.domElement;
    container.append(this.canvas);
    this.view = new Viewpoint(this.canvas);
    this.view.onChange = this.invalidate;
    this.picker = new Picker(this.canvas, this.view.camera, this.objects.garment);
    this.resolution = new Resolution(this.renderer, this.render);
    this.scene.add(new three.HemisphereLight(0xffffff, 0x5b6270, 2.2));
    const sun = new three.DirectionalLight(0xffffff, 1.6);
    sun.position.set(0.6, 1, 0.9);
    this.view.camera.add(sun);
    this.scene.add(this.view.camera, ...Object.values(this.objects));
    this.observer = new ResizeObserver(this.resize);
    this.observer.observe(container);
    this.applyTheme();
  }

  close(): void {
    this.closed = true;
    this.observer.disconnect();
    this.view.close();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  /** The topology, and the shape until a result comes. */
  setMeshes(faces: Uint32Array, rest: Float32Array, body: { vertices: Float32Array; faces: Uint32Array } | undefined): void {
    this.faces = faces;
    this.objects.garment.geometry.setIndex(new three.BufferAttribute(faces, 1));
    if (body) {
      this.objects.body.geometry.setIndex(new three.BufferAttribute(body.faces, 1));
      put(this.objects.body.geometry, "position", body.vertices);
      this.objects.body.geometry.computeVertexNormals();
    }
    this.objects.body.visible = body !== undefined;
    this.drawGarment(rest);
  }

  /** Shows the garment, body and cloud of a moment. */
  show(shape: Shape): void {
    this.shape = shape;
    this.drawGarment(shape.vertices);
    const body = shape.cloud?.body;
    if (body && body.length === this.objects.body.geometry.getAttribute("position").array.length) {
      put(this.objects.body.geometry, "position", body);
      this.objects.body.geometry.computeVertexNormals();
    }
    this.drawCloud(shape.cloud);
    this.placeSensor(shape.cloud?.sensor);
  }

  /** Draws the same moment again, after a change of mode or layers. */
  refresh(): void {
    if (this.shape) this.show(this.shape);
    else this.invalidate();
  }

  readonly invalidate = (): void => {
    if (this.requested) return;
    this.requested = true;
    const { pause } = this.resolution;
    if (pause > 0) setTimeout(() => requestAnimationFrame(this.draw), pause);
    else requestAnimationFrame(this.draw);
  };

  /** Points the camera at the garment, from the sensor's side. */
  frame(): void {
    const box = new three.Box3().setFromObject(this.objects.garment);
    if (box.isEmpty()) return;
    this.view.lookAt(this.sphere, this.shape?.cloud?.sensor);
    this.placeFloor(this.objects.body.visible ? new three.Box3().setFromObject(this.objects.body) : box);
    this.invalidate();
  }

  /** Lets the view go along with a garment that moves away, from where it is now. */
  setFollowing(follows: boolean): void {
    this.view.setFollowing(follows, this.sphere);
  }

  /** Shows the 90 % ellipsoid of a vertex; undefined: none. */
  showEllipsoid(vertex: number | undefined): void {
    const shape = this.shape;
    this.objects.ellipsoid.visible = vertex !== undefined && shape !== undefined && 3 * vertex < shape.vertices.length;
    if (this.objects.ellipsoid.visible && shape && vertex !== undefined) {
      const radius = RADIUS_90 * shape.sigma[vertex]!;
      const covariance = shape.covariance?.subarray(6 * vertex, 6 * vertex + 6);
      const m = covariance ? ellipsoid90(covariance) : [radius, 0, 0, 0, radius, 0, 0, 0, radius];
      const [x, y, z] = [shape.vertices[3 * vertex]!, shape.vertices[3 * vertex + 1]!, shape.vertices[3 * vertex + 2]!];
      const axes = [0, 3, 6].flatMap((k) => [m[k]!, m[k + 1]!, m[k + 2]!, 0]);
      this.objects.ellipsoid.matrix.fromArray([...axes, x, y, z, 1]);
      this.objects.ellipsoid.matrixWorldNeedsUpdate = true;
    }
    this.invalidate();
  }

  /** Shows where a vertex has been, (K, 3) metres; empty: nothing. */
  showTrail(positions: Float32Array): void {
    this.objects.trail.visible = positions.length >= 6;
    put(this.objects.trail.geometry, "position", positions);
    this.invalidate();
  }

  applyTheme(): void {
    const of = (name: string) => new three.Color(colour(name));
    const { material } = this.objects.cloud;
    material.color.copy(material.vertexColors ? new three.Color("white") : of("cloud"));
    this.objects.wires.material.color.copy(of("text"));
    this.objects.ellipsoid.material.color.copy(of("mark"));
    this.objects.trail.material.color.copy(of("mark"));
    this.objects.sensor.material.color.copy(of("muted"));
    this.objects.body.material.color.copy(of("body"));
    if (this.framed)
      this.placeFloor(new three.Box3().setFromObject(this.objects.body.visible ? this.objects.body : this.objects.garment));
    this.invalidate();
  }

  /** The view as a PNG. */
  picture(): Promise<Blob | null> {
    this.renderer.render(this.scene, this.view.camera);
    return new Promise((resolve) => {
      this.canvas.toBlob(resolve, "image/png");
    });
  }

  /** About the garment. */
  private get sphere(): three.Sphere {
    return this.objects.garment.geometry.boundingSphere ?? new three.Sphere();
  }

  /** Points in the colours that their sensor saw, where it saw any. */
  private drawCloud(cloud: Cloud | undefined): void {
    const { geometry, material } = this.objects.cloud;
    put(geometry, "position", cloud?.points ?? new Float32Array());
    const coloured = cloud?.colors !== undefined;
    if (cloud?.colors) put(geometry, "color", toLinear(cloud.colors));
    if (coloured === material.vertexColors) return;
    material.vertexColors = coloured;
    material.needsUpdate = true;
    this.applyTheme();
  }

  private drawGarment(vertices: Float32Array): void {
    put(this.objects.garment.geometry, "position", vertices);
    const normals = vertexNormals(vertices, this.faces);
    put(this.objects.garment.geometry, "normal", normals);
    const colours = this.objects.garment.geometry.getAttribute("color").array as Float32Array;
    const target = colours.length === vertices.length ? colours : new Float32Array(vertices.length);
    this.colourVertices(vertices, normals, target);
    put(this.objects.garment.geometry, "color", target);
    this.objects.garment.geometry.computeBoundingSphere();
    if (!this.framed && vertices.length > 0) {
      this.framed = true;
      this.guessUp();
      this.frame();
    } else this.view.follow(this.sphere);
    this.objects.cloud.visible = this.layers.cloud;
    this.objects.wires.visible = this.layers.wires;
    this.objects.body.visible = this.layers.body && this.objects.body.geometry.index !== null;
    this.invalidate();
  }

  private colourVertices(vertices: Float32Array, normals: Float32Array, colours: Float32Array): void {
    const scale = SCALES[this.mode];
    if (this.mode === "normals") paintNormals(normals, colours);
    else if (!this.shape || !scale) paintPlain(colours);
    else if (this.mode === "difference")
      paint(this.shape.difference ?? new Float32Array(vertices.length / 3).fill(NaN), scale, colours);
    else if (this.mode === "residual")
      paint(distancesTo(vertices, this.shape.cloud?.points ?? new Float32Array()), scale, colours);
    else paint(this.mode === "sigma" ? this.shape.sigma : this.shape.reliability, scale, colours);
  }

  /** People are taller than wide: the longest side of the body is taken for the vertical. */
  private guessUp(): void {
    if (!this.objects.body.visible) return;
    const size = new three.Box3().setFromObject(this.objects.body).getSize(new three.Vector3());
    this.view.up = size.z > size.y && size.z > size.x ? "z" : "y";
  }

  private placeFloor(box: three.Box3): void {
    this.scene.remove(this.floor);
    this.floor.dispose();
    const size = Math.max(1, 2 * Math.ceil(box.getSize(new three.Vector3()).length()));
    this.floor = new three.GridHelper(size, 4 * size, colour("grid-strong"), colour("grid"));
    const centre = box.getCenter(new three.Vector3());
    this.floor.quaternion.setFromUnitVectors(new three.Vector3(0, 1, 0), this.view.upward);
    this.floor.position
      .copy(centre)
      .addScaledVector(this.view.upward, this.view.up === "y" ? box.min.y - centre.y : box.min.z - centre.z);
    this.scene.add(this.floor);
  }

  private placeSensor(sensor: [number, number, number] | undefined): void {
    this.objects.sensor.visible = sensor !== undefined && this.layers.cloud;
    if (!sensor) return;
    this.objects.sensor.position.set(...sensor);
    const away = this.objects.sensor.position.clone().sub(this.view.target).normalize();
    this.objects.sensor.quaternion.setFromUnitVectors(new three.Vector3(0, 1, 0), away);
  }

  private readonly draw = (): void => {
    this.requested = false;
    if (this.closed) return;
    this.resolution.measure();
    this.render();
  };

  /** Draws at once, also after a new size has cleared the canvas. */
  private readonly render = (): void => {
    this.renderer.render(this.scene, this.view.camera);
  };

  private readonly resize = (): void => {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement!;
    if (width === 0 || height === 0) return;
    this.view.camera.aspect = width / height;
    this.view.camera.updateProjectionMatrix();
    this.renderer.setSize(width, height, false);
    this.render();
  };
}
