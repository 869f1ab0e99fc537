"use strict";

// Arrays as they come from Python, and vectors of three numbers. All arithmetic of the page is in float64.

const BASE64 = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

// The bytes of a base64 text, without `atob`: an engine outside of a browser has none.
function bytesOf(text) {
  const digit = new Uint8Array(128);
  for (let k = 0; k < 64; k += 1) {
    digit[BASE64.charCodeAt(k)] = k;
  }
  const padding = text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0;
  const bytes = new Uint8Array((text.length / 4) * 3);
  for (let k = 0, at = 0; k < text.length; k += 4, at += 3) {
    const word =
      (digit[text.charCodeAt(k)] << 18) |
      (digit[text.charCodeAt(k + 1)] << 12) |
      (digit[text.charCodeAt(k + 2)] << 6) |
      digit[text.charCodeAt(k + 3)];
    bytes[at] = word >> 16;
    bytes[at + 1] = (word >> 8) & 255;
    bytes[at + 2] = word & 255;
  }
  return bytes.slice(0, bytes.length - padding);
}

// The values of an array {dtype, shape, base64}. A bfloat16 is the upper half of a float32.
function valuesOf(array) {
  const buffer = bytesOf(array.base64).buffer;
  if (array.dtype === "float64") {
    return new Float64Array(buffer);
  }
  if (array.dtype === "float32") {
    return Float64Array.from(new Float32Array(buffer));
  }
  const upper = Uint32Array.from(new Uint16Array(buffer), (half) => half << 16);
  return Float64Array.from(new Float32Array(upper.buffer));
}

// What Python wrote, with {shape, values} in the place of each array.
function decoded(data) {
  if (data === null || typeof data !== "object") {
    return data;
  }
  if ("base64" in data) {
    return { shape: data.shape, values: valuesOf(data) };
  }
  if (Array.isArray(data)) {
    return data.map(decoded);
  }
  return Object.fromEntries(Object.entries(data).map(([name, value]) => [name, decoded(value)]));
}

// Row k of an array {shape, values}, flat.
function rowOf(array, k) {
  const length = array.values.length / array.shape[0];
  return array.values.subarray(k * length, (k + 1) * length);
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function norm(a) {
  return Math.sqrt(dot(a, a));
}

function scaled(a, factor) {
  return [a[0] * factor, a[1] * factor, a[2] * factor];
}

function sum(...vectors) {
  return [0, 1, 2].map((k) => vectors.reduce((total, vector) => total + vector[k], 0));
}

function unit(a) {
  return scaled(a, 1 / norm(a));
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
