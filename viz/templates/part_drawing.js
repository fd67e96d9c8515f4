// Draws the part by WebGL: a surface whose vertices carry a value before and one after, and the share between.
"use strict";

// How to write the values and how to paint; without WebGL triangle by triangle.
function partDrawing(canvas, numbers, colours) {
  const { vertices, normals, triangles, count } = numbers;
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true });
  if (!gl) return flatDrawing(canvas, numbers, colours);
  const vertexCode = `#version 300 es
    in vec3 place; in vec3 normal; in float before; in float after;
    uniform mat3 turn; uniform vec2 scale; uniform vec2 shift; uniform float dot;
    uniform float blend; uniform float full; uniform float isSigned;
    out vec3 facing; out float share; out float known;
    void main() {
      vec3 p = turn * place;
      facing = turn * normal;
      known = min(before, after) < -1e8 ? 0.0 : 1.0;
      float value = mix(before, after, blend);
      // An unknown value weighs nothing, so that it does not darken the triangles between it and known ones.
      share = known * (isSigned > 0.5 ? 0.5 + value / (2.0 * full) : value / full);
      gl_Position = vec4(p.xy * scale + shift, -p.z * 0.5, 1.0);
      gl_PointSize = dot;
    }`;
  const pixelCode = `#version 300 es
    precision highp float;
    in vec3 facing; in float share; in float known;
    uniform sampler2D map; uniform float row; uniform float edge;
    out vec4 colour;
    void main() {
      vec3 n = normalize(facing);
      // So little that no colour of the legend turns into another.
      float light = 0.84 + 0.16 * abs(dot(n, normalize(vec3(-0.25, 0.45, 0.86))));
      float place = clamp(share / max(known, 0.5), 0.0, 1.0);
      vec3 hatched = vec3(mod(gl_FragCoord.x + gl_FragCoord.y, 10.0) < 5.0 ? 0.56 : 0.72);
      vec3 base = known > 0.5 ? texture(map, vec2(edge + (1.0 - 2.0 * edge) * place, row)).rgb : hatched;
      colour = vec4(base * light, 1.0);
    }`;
  const compiled = (kind, code) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, code); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  };
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl.VERTEX_SHADER, vertexCode));
  gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, pixelCode));
  gl.linkProgram(program); gl.useProgram(program);
  const at = name => gl.getUniformLocation(program, name);
  const attribute = (name, array, size, type, normalised) => {
    const buffer = gl.createBuffer(), place = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, array, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(place); gl.vertexAttribPointer(place, size, type, normalised, 0, 0);
    return buffer;
  };
  const padded = (from, Kind) => {  // attributes of three small numbers would not lie on four bytes
    const out = new Kind(4 * count);
    for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) out[4 * i + k] = from[3 * i + k];
    return out;
  };
  attribute("place", padded(vertices, Int16Array), 4, gl.SHORT, true);
  attribute("normal", padded(normals, Int8Array), 4, gl.BYTE, true);
  const beforeBuffer = attribute("before", new Float32Array(count), 1, gl.FLOAT, false);
  const afterBuffer = attribute("after", new Float32Array(count), 1, gl.FLOAT, false);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
  const stops = colours.field.length, picture = new Uint8Array(4 * 2 * stops);
  ["field", "signed"].forEach((name, row) => colours[name].forEach((rgb, i) =>
    picture.set([...rgb, 255], 4 * (row * stops + i))));
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, stops, 2, 0, gl.RGBA, gl.UNSIGNED_BYTE, picture);
  for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]])
    gl.texParameteri(gl.TEXTURE_2D, key, value);

  return {
    write(before, after) {
      for (const [buffer, values] of [[beforeBuffer, before], [afterBuffer, after]]) {
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferSubData(gl.ARRAY_BUFFER, 0, values);
      }
    },
    paint({ turn, scale, shift, zoom, blend, full, signed }) {
      const ratio = window.devicePixelRatio || 1;
      const [w, h] = [canvas.clientWidth, canvas.clientHeight].map(x => Math.round(x * ratio));
      if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
      gl.viewport(0, 0, w, h);
      gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); gl.enable(gl.DEPTH_TEST);
      gl.uniformMatrix3fv(at("turn"), false, turn);
      gl.uniform2f(at("scale"), ...scale);
      gl.uniform2f(at("shift"), ...shift);
      gl.uniform1f(at("dot"), Math.max(1.5, ratio * zoom * 3));
      gl.uniform1f(at("blend"), blend); gl.uniform1f(at("full"), full);
      gl.uniform1f(at("isSigned"), signed ? 1 : 0); gl.uniform1f(at("row"), signed ? 0.75 : 0.25);
      gl.uniform1f(at("edge"), 0.5 / stops);  // from the middle of the first stop to that of the last
      if (triangles.length) gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(gl.POINTS, 0, count);
    },
  };
}

// The same by a plain canvas, from the back to the front.
function flatDrawing(canvas, { vertices, normals, triangles, count }, colours) {
  const ink = canvas.getContext("2d"), faces = triangles.length ? triangles.length / 3 : 0;
  let before = new Float32Array(count), after = before;
  const colourOf = (value, full, signed, light) => {
    if (value < -1e8) return "rgb(150,150,150)";
    const stops = signed ? colours.signed : colours.field, share = signed ? 0.5 + value / (2 * full) : value / full;
    const place = Math.min(1, Math.max(0, share)) * (stops.length - 1), k = Math.min(Math.floor(place), stops.length - 2);
    return `rgb(${stops[k].map((c, i) => Math.round(light * (c + (place - k) * (stops[k + 1][i] - c)))).join(",")})`;
  };
  return {
    write(from, to) { before = from; after = to; },
    paint({ turn: m, scale, shift, blend, full, signed }) {
      const w = canvas.width = canvas.clientWidth, h = canvas.height = canvas.clientHeight, place = new Float32Array(3 * count);
      for (let i = 0; i < count; i++) {
        const [p, q, r] = [0, 1, 2].map(k => vertices[3 * i + k] / 32767);
        place[3 * i] = ((m[0] * p + m[3] * q + m[6] * r) * scale[0] + shift[0] + 1) / 2 * w;
        place[3 * i + 1] = (1 - (m[1] * p + m[4] * q + m[7] * r) * scale[1] - shift[1]) / 2 * h;
        place[3 * i + 2] = m[2] * p + m[5] * q + m[8] * r;
      }
      const depth = new Float32Array(faces);
      for (let f = 0; f < faces; f++) depth[f] = place[3 * triangles[3 * f] + 2] + place[3 * triangles[3 * f + 1] + 2] + place[3 * triangles[3 * f + 2] + 2];
      for (const f of Uint32Array.from(depth.keys()).sort((a, b) => depth[a] - depth[b])) {
        const [a, b, c] = [0, 1, 2].map(k => triangles[3 * f + k]);
        const values = [a, b, c].map(i => before[i] + blend * (after[i] - before[i])), turned = (m[2] * normals[3 * a] + m[5] * normals[3 * a + 1] + m[8] * normals[3 * a + 2]) / 127;
        ink.fillStyle = ink.strokeStyle = colourOf(Math.min(...values) < -1e8 ? -1e9 : (values[0] + values[1] + values[2]) / 3, full, signed, 0.84 + 0.16 * Math.abs(turned));
        ink.beginPath();
        [a, b, c].forEach((i, k) => ink[k ? "lineTo" : "moveTo"](place[3 * i], place[3 * i + 1]));
        ink.closePath(); ink.fill(); ink.stroke();
      }
    },
  };
}
