"use strict";
// Columns of numbers: base64 of little-endian values (icrtool/output/page/drive_data.py writes them).
const icrtoolColumns = (() => {
  function bytesOf(text) {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes.buffer;
  }

  /** Return the numbers of a column as a typed array. */
  function decode(column) {
    if (column.type === "f32") return new Float32Array(bytesOf(column.data));
    const steps = new Int16Array(bytesOf(column.data));
    if (column.type === "levels") return Float64Array.from(steps, (step) => step * column.unit);
    // A running sum has one number more than steps.
    const sums = new Float64Array(steps.length + 1).fill(column.first);
    let units = 0;
    for (let i = 0; i < steps.length; i++) {
      units += steps[i];
      sums[i + 1] += units * column.unit;
    }
    return sums;
  }

  /** Return data with every column in it decoded. */
  function decodeAll(data) {
    if (data === null || typeof data !== "object") return data;
    if (typeof data.data === "string" && typeof data.type === "string") return decode(data);
    if (Array.isArray(data)) return data.length && typeof data[0] === "object" ? data.map(decodeAll) : data;
    return Object.fromEntries(Object.entries(data).map(([name, value]) => [name, decodeAll(value)]));
  }

  /** Return the first index at which an ascending array is not below a value. */
  function firstAtLeast(values, value, from = 0) {
    let low = from, high = values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] < value) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  return { decodeAll, firstAtLeast };
})();
