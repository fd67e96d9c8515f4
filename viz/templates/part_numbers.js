// The numbers of the part's viewer, unpacked from the data that the page holds.
"use strict";

const UNKNOWN = -1e9;  // a value that nobody knows

function partNumbers(data) {
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const vertices = new Int16Array(bytes(data.vertices)), normals = new Int8Array(bytes(data.normals));
  const triangles = Uint32Array.from(new (vertices.length / 3 > 65535 ? Uint32Array : Uint16Array)(bytes(data.triangles))), near = new Uint16Array(bytes(data.near));
  const weight = new Uint8Array(bytes(data.weight)), count = vertices.length / 3;
  const unpack = packed => {
    const raw = new Int16Array(bytes(packed.data)), out = new Float32Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw[i] === -32768 ? NaN : raw[i] * packed.count;
    return out;
  };
  const onVertices = values => {
    const out = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      let sum = 0, total = 0;
      for (let k = 3 * i; k < 3 * i + 3; k++) {
        const v = values[near[k]];
        if (!Number.isNaN(v)) { sum += weight[k] * v; total += weight[k]; }
      }
      out[i] = total ? sum / total : UNKNOWN;
    }
    return out;
  };
  return { bytes, vertices, normals, triangles, near, weight, count, unpack, onVertices };
}
