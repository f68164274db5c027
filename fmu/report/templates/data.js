// What the page keeps for its scripts (fmu/report/packed.py): JSON, and arrays of few bits after it.

const KINDS = { i1: Int8Array, i2: Int16Array, u2: Uint16Array, u4: Uint32Array, i4: Int32Array, f4: Float32Array };

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const whole = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  const length = new DataView(whole).getUint32(0, true);
  const array = ({ at, type, n, middle, step }) => {
    const found = new KINDS[type](whole, 4 + length + at, n), missing = type === "i1" ? 127 : 32767;
    return step === undefined ? found : Float32Array.from(found, x => x === missing ? NaN : middle + step * x);
  };
  return JSON.parse(new TextDecoder().decode(new Uint8Array(whole, 4, length)),
    (key, value) => value && value.at !== undefined && value.type ? array(value) : value);
}
