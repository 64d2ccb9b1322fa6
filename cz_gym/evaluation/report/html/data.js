/* The page's data, and its packed signals: see cz_gym/evaluation/report/page_signals.py for the format. */
const FACTS = JSON.parse(document.getElementById("facts").textContent);
const EPISODES = JSON.parse(document.getElementById("episodes").textContent);

/** Signals of a packed text by key, each a Float64Array in its unit; curves are [key, unit, resolution]. */
async function unpack(text, curves) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const numbers = zigzags(bytes);
  const steps = numbers.length / curves.length;
  const found = {};
  curves.forEach(([key, , resolution], i) => {
    const values = new Float64Array(steps);
    let whole = 0;
    for (let k = 0; k < steps; k++) {
      whole += numbers[i * steps + k];
      values[k] = whole * resolution;
    }
    found[key] = values;
  });
  return found;
}

/** Whole numbers of variable length: seven bits a byte, the low ones first; even ones positive, odd ones negative. */
function zigzags(bytes) {
  const numbers = [];
  let number = 0, weight = 1;
  for (const byte of bytes) {
    number += (byte & 127) * weight;
    weight *= 128;
    if (byte < 128) {
      numbers.push(number % 2 ? -(number + 1) / 2 : number / 2);
      number = 0;
      weight = 1;
    }
  }
  return numbers;
}

const unpacked = new Map();

/** The same, each text unpacked once. */
function signalsOf(text, curves) {
  if (!unpacked.has(text)) unpacked.set(text, unpack(text, curves));
  return unpacked.get(text);
}
