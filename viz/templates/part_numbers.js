// The numbers of the part's viewer, unpacked from the data that the page holds.
"use strict";

const UNKNOWN = -1e9;  // a value that nobody knows

function partNumbers(data) {
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const vertices = new Int16Array(bytes(data.vertices)), normals = new Int8Array(bytes(data.normals));
  const triangles = Uint32Array.from(new (vertices.length / 3 > 65535 ? Uint32Array : Uint16Array)(bytes(data.triangles))), near = new Uint16Array(bytes(data.near));
  const weight = new Uint8Array(bytes(data.weight)), count = vertices.length / 3;
  const unpack = packed => {
    const raw = new (packed.bits === 8 ? Int8Array : Int16Array)(bytes(packed.data)), out = new Float32Array(raw.length), unknown = packed.bits === 8 ? -128 : -32768;
    for (let i = 0; i < raw.length; i++) out[i] = raw[i] === unknown ? NaN : raw[i] * packed.count;
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

// The place of a diagnosis that is nearest to each patch of the part.
function nearestPlaces(data, { bytes }, places) {
  const own = new Float32Array(bytes(data.patches)), out = new Uint16Array(own.length / 3);
  const turned = places.map(p => data.axes.map((axis, k) => ((axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2]) - data.centre[k]) / data.size));
  for (let i = 0; i < out.length; i++) {
    let best = Infinity;
    for (let j = 0; j < turned.length; j++) {
      const d = (turned[j][0] - own[3 * i]) ** 2 + (turned[j][1] - own[3 * i + 1]) ** 2 + (turned[j][2] - own[3 * i + 2]) ** 2;
      if (d < best) { best = d; out[i] = j; }
    }
  }
  return out;
}
