"use strict";

// A policy's network, one step at a time: encoder, GTrXL blocks, policy head. As `Agent.encode_step` of the scripts,
// in float64 from their float32 weights. Weights are Float64Arrays. What is computed are plain arrays: engines make them
// several times faster. It needs numbers.js.

const NEAR = 10; // units of a difference from the nominal flight up to which the blocks see it
const FAR = 100; // up to which a direct path sees it, as in `past_the_blocks` of the rocket's script

// W x + b; weight {shape: [outputs, inputs], values}, bias {values} or none.
function linear(weight, bias, x) {
  const [outputs, inputs] = weight.shape;
  const { values } = weight;
  const y = [];
  for (let k = 0, at = 0; k < outputs; k += 1) {
    let total = bias ? bias.values[k] : 0;
    for (let j = 0; j < inputs; j += 1, at += 1) {
      total += values[at] * x[j];
    }
    y.push(total);
  }
  return y;
}

// The error function by its series of positive terms (Abramowitz and Stegun, 7.1.6), to rounding.
function erf(x) {
  if (Math.abs(x) > 6) {
    return Math.sign(x);
  }
  let term = x;
  let total = x;
  for (let n = 1; Math.abs(term) > 1e-17 * Math.abs(total); n += 1) {
    term *= (2 * x * x) / (2 * n + 1);
    total += term;
  }
  return (2 / Math.sqrt(Math.PI)) * Math.exp(-x * x) * total;
}

function gelu(x) {
  return x.map((value) => 0.5 * value * (1 + erf(value / Math.SQRT2)));
}

function layerNorm(norm, x) {
  const mean = x.reduce((total, value) => total + value, 0) / x.length;
  const variance = x.reduce((total, value) => total + (value - mean) ** 2, 0) / x.length;
  const scale = 1 / Math.sqrt(variance + 1e-5); // torch's epsilon
  return x.map((value, k) => (value - mean) * scale * norm.weight.values[k] + norm.bias.values[k]);
}

function added(x, y) {
  return x.map((value, k) => value + y[k]);
}

// gate(x, y) = lambda x + (1 - lambda) y, lambda = sigmoid(W [x, y] + b)
function gate(layer, x, y) {
  return linear(layer.weight, layer.bias, [...x, ...y]).map((value, k) => {
    const lambda = 1 / (1 + Math.exp(-value));
    return lambda * x[k] + (1 - lambda) * y[k];
  });
}

function softmax(scores) {
  const largest = Math.max(...scores);
  const weights = scores.map((score) => Math.exp(score - largest));
  const total = weights.reduce((partial, weight) => partial + weight, 0);
  return weights.map((weight) => weight / total);
}

// MultiHead(x) of one step. `past`: the keys and values of the L steps before, the oldest first.
// Score of the step that is `distance` back: q (k + R_distance) / sqrt(dk).
function attend(attention, x, past, heads) {
  const now = {
    key: linear(attention.key.weight, null, x),
    value: linear(attention.value.weight, null, x),
  };
  const query = linear(attention.query.weight, null, x);
  const seen = [...past, now];
  const dk = x.length / heads;
  const attended = Array(x.length).fill(0);
  for (let head = 0; head < heads; head += 1) {
    const first = head * dk;
    const scores = seen.map(({ key }, j) => {
      const distance = past.length - j;
      const relative = (head * (past.length + 1) + distance) * dk;
      let score = 0;
      for (let k = 0; k < dk; k += 1) {
        score += query[first + k] * (key[first + k] + attention.R.values[relative + k]);
      }
      return score / Math.sqrt(dk);
    });
    softmax(scores).forEach((weight, j) => {
      for (let k = first; k < first + dk; k += 1) {
        attended[k] += weight * seen[j].value[k];
      }
    });
  }
  return { attended: linear(attention.out.weight, null, attended), past: seen.slice(1) };
}

// h1 = gate(x, LayerNorm(x + MultiHead(x))), h2 = gate(h1, LayerNorm(h1 + MLP(h1)))
function blockStep(block, x, attended) {
  const h1 = gate(block.gate1.linear, x, layerNorm(block.norm1, added(x, attended)));
  const [first, , second] = block.mlp;
  const wide = gelu(linear(first.weight, first.bias, h1));
  const mlp = linear(second.weight, second.bias, wide);
  return gate(block.gate2.linear, h1, layerNorm(block.norm2, added(h1, mlp)));
}

// {"encoder.0.weight": w} as {encoder: [{weight: w}]}: torch's names as a tree.
function treeOf(tensors) {
  const tree = {};
  for (const [name, tensor] of Object.entries(tensors)) {
    const path = name.split(".");
    let place = tree;
    path.slice(0, -1).forEach((part, k) => {
      place[part] = place[part] || (/^\d+$/.test(path[k + 1]) ? [] : {});
      place = place[part];
    });
    place[path[path.length - 1]] = tensor;
  }
  return tree;
}

// The network of a policy {heads, memory_length, tensors}. `constants` are its buffers, which the features need.
class Network {
  constructor(policy) {
    this.heads = policy.heads;
    this.memoryLength = policy.memory_length;
    this.constants = treeOf(policy.tensors);
    this.begin();
  }

  // Begin a flight, with a memory of zeros.
  begin() {
    const width = this.constants.encoder[0].weight.shape[0];
    const nothing = { key: Array(width).fill(0), value: Array(width).fill(0) };
    this.pasts = (this.constants.blocks || []).map(() => Array(this.memoryLength).fill(nothing));
  }

  // The policy head's output for the features of the next step.
  step(features) {
    const { encoder, blocks, actor, direct } = this.constants;
    const first = direct ? features.length - direct.weight.shape[1] : features.length; // from here on they pass by, too
    const seen = features.map((value, k) => (k < first ? value : clamp(value, -NEAR, NEAR)));
    let x = gelu(linear(encoder[0].weight, encoder[0].bias, seen));
    (blocks || []).forEach((block, k) => {
      const { attended, past } = attend(block.attention, x, this.pasts[k], this.heads);
      this.pasts[k] = past;
      x = blockStep(block, x, attended);
    });
    if (direct) {
      x = added(x, linear(direct.weight, null, features.slice(first)));
    }
    const hidden = gelu(linear(actor[0].weight, actor[0].bias, x));
    return linear(actor[2].weight, actor[2].bias, hidden);
  }
}
