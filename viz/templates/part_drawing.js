// Draws the part by WebGL: a surface whose vertices carry a value before and one after, and the share between.
"use strict";

// Null where the browser has no WebGL; else how to write the values and how to paint.
function partDrawing(canvas, { vertices, normals, triangles, count }, colours) {
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (!gl) return null;
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
    uniform sampler2D map; uniform float row;
    out vec4 colour;
    void main() {
      vec3 n = normalize(facing);
      float light = 0.55 + 0.45 * abs(dot(n, normalize(vec3(-0.25, 0.45, 0.86))));
      float place = clamp(share / max(known, 0.5), 0.0, 1.0);
      vec3 base = known > 0.5 ? texture(map, vec2(0.03 + 0.94 * place, row)).rgb : vec3(0.62);
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
      if (triangles.length) gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(gl.POINTS, 0, count);
    },
  };
}
