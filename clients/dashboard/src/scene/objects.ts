/** Objects of the scene: the garment with its edges, the body, the cloud and the marks. */
import * as three from "three";

/** Makes the objects, without shapes yet. */
export function objects() {
  const garment = surface(new three.MeshStandardMaterial({ vertexColors: true, side: three.DoubleSide, roughness: 0.75 }));
  const wires = new three.Mesh(
    garment.geometry,
    new three.MeshBasicMaterial({ wireframe: true, transparent: true, opacity: 0.25 }),
  );
  const body = surface(
    new three.MeshStandardMaterial({
      color: 0x8b93a1,
      roughness: 0.9,
      polygonOffset: true,
      polygonOffsetFactor: 3,
      polygonOffsetUnits: 6,
    }),
  );
  const cloud = new three.Points(
    new three.BufferGeometry(),
    new three.PointsMaterial({ size: 0.004, transparent: true, opacity: 0.7 }),
  );
  const ellipsoid = new three.Mesh(
    new three.SphereGeometry(1, 24, 16),
    new three.MeshBasicMaterial({ transparent: true, opacity: 0.45, depthTest: false }),
  );
  const trail = new three.Line(new three.BufferGeometry(), new three.LineBasicMaterial({ depthTest: false }));
  const sensor = new three.Mesh(new three.ConeGeometry(0.05, 0.08, 4, 1, true), new three.MeshBasicMaterial({ wireframe: true }));
  for (const [order, object] of [body, trail, ellipsoid].entries()) object.renderOrder = 1 + order;
  for (const hidden of [ellipsoid, trail, sensor, wires, body]) hidden.visible = false;
  for (const name of ["position", "color"]) put(garment.geometry, name, new Float32Array());
  put(body.geometry, "position", new Float32Array());
  ellipsoid.matrixAutoUpdate = false;
  return { garment, wires, body, cloud, ellipsoid, trail, sensor };
}

function surface(material: three.MeshStandardMaterial): three.Mesh<three.BufferGeometry, three.MeshStandardMaterial> {
  const mesh = new three.Mesh(new three.BufferGeometry(), material);
  mesh.frustumCulled = false;
  return mesh;
}

/** Sets rows of three without a copy; an attribute of the same size is used again. */
export function put(geometry: three.BufferGeometry, name: string, values: Float32Array): void {
  const attribute = geometry.getAttribute(name) as three.BufferAttribute | undefined;
  if (attribute?.array.length === values.length) {
    attribute.array = values;
    attribute.needsUpdate = true;
  } else geometry.setAttribute(name, new three.BufferAttribute(values, 3));
  if (name === "position") geometry.boundingSphere = null;
}
