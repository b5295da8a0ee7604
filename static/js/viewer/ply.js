// Reads PLY files (binary little-endian, or ASCII) into typed arrays: points, colours, and the lines of cameras.

const SIZES = { char: 1, int8: 1, uchar: 1, uint8: 1, short: 2, int16: 2, ushort: 2, uint16: 2, int: 4, int32: 4, uint: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8 };

/**
 * @param {ArrayBuffer} buffer
 * @returns {{positions: Float32Array, colors: Uint8Array|null, lines: Uint32Array, comments: string[]}}
 *   positions as x y z, colours as r g b, lines as pairs of vertex numbers (from edges, else from the sides of faces)
 */
export function parsePly(buffer) {
  const { elements, format, comments, start } = readHeader(buffer);
  const source = format === "ascii" ? asciiReader(buffer, start) : binaryReader(buffer, start);
  const result = { positions: new Float32Array(0), colors: null, lines: new Uint32Array(0), comments };
  const edges = [];
  const sides = [];
  for (const element of elements) {
    if (element.name === "vertex") readVertices(element, source, result, format);
    else readRows(element, source, (row) => {
      if (element.name === "edge") edges.push(row.vertex1, row.vertex2);
      const corners = row.vertex_indices ?? row.vertex_index;
      if (element.name === "face" && corners) corners.forEach((corner, k) => sides.push(corner, corners[(k + 1) % corners.length]));
    });
  }
  result.lines = Uint32Array.from(edges.length > 0 ? edges : sides);
  const vertices = result.positions.length / 3;
  if (result.lines.some((vertex) => vertex >= vertices)) throw new Error("a line of the PLY file names a vertex that is not there");
  return result;
}

function readHeader(buffer) {
  // The header is short text; its end is looked for in the first part only.
  const text = new TextDecoder("latin1").decode(buffer.slice(0, 65536));
  const end = text.match(/^end_header\r?\n/m);
  if (!text.startsWith("ply") || !end) throw new Error("this is not a PLY file");
  const elements = [];
  const comments = [];
  let format = null;
  for (const line of text.slice(0, end.index).split(/\r?\n/)) {
    const words = line.trim().split(/\s+/);
    if (words[0] === "format") format = words[1];
    else if (words[0] === "comment") comments.push(new TextDecoder().decode(Uint8Array.from(line.slice(8), (c) => c.charCodeAt(0))));
    else if (words[0] === "element") elements.push({ name: words[1], count: Number(words[2]), properties: [] });
    else if (words[0] === "property" && words[1] === "list") elements.at(-1).properties.push({ count: words[2], type: words[3], name: words[4], list: true });
    else if (words[0] === "property") elements.at(-1).properties.push({ type: words[1], name: words[2], list: false });
  }
  if (format !== "ascii" && format !== "binary_little_endian") throw new Error(`PLY files of the format ${format} can't be shown`);
  for (const { properties } of elements) {
    for (const { type, count } of properties) {
      if (!(type in SIZES) || (count !== undefined && !(count in SIZES))) throw new Error(`the PLY file has a property of the unknown type ${type}`);
    }
  }
  return { elements, format, comments, start: end.index + end[0].length };
}

function readVertices(element, source, result, format) {
  const names = element.properties.map((property) => property.name);
  for (const axis of ["x", "y", "z"]) if (!names.includes(axis)) throw new Error("the PLY file has no x y z");
  const coloured = ["red", "green", "blue"].every((name) => names.includes(name));
  const positions = new Float32Array(3 * element.count);
  const colors = coloured ? new Uint8Array(3 * element.count) : null;
  const plain = element.properties.every((property) => !property.list);
  if (format !== "ascii" && plain) {
    // Millions of points: read by offset, without making an object for each.
    const { view, at } = source;
    let stride = 0;
    const columns = {};
    for (const { name, type } of element.properties) {
      columns[name] = { offset: stride, read: readerOf(type) };
      stride += SIZES[type];
    }
    if (at() + stride * element.count > view.byteLength) throw new Error("the PLY file is cut short");
    const base = at();
    ["x", "y", "z"].forEach((name, k) => {
      const { offset, read } = columns[name];
      for (let i = 0; i < element.count; i += 1) positions[3 * i + k] = read(view, base + i * stride + offset);
    });
    if (coloured) {
      ["red", "green", "blue"].forEach((name, k) => {
        const { offset, read } = columns[name];
        for (let i = 0; i < element.count; i += 1) colors[3 * i + k] = read(view, base + i * stride + offset);
      });
    }
    source.skip(stride * element.count);
  } else {
    let i = 0;
    readRows(element, source, (row) => {
      positions.set([row.x, row.y, row.z], 3 * i);
      colors?.set([row.red, row.green, row.blue], 3 * i);
      i += 1;
    });
  }
  result.positions = positions;
  result.colors = colors;
}

function readRows(element, source, take) {
  for (let i = 0; i < element.count; i += 1) {
    const row = {};
    for (const property of element.properties) {
      row[property.name] = property.list
        ? Array.from({ length: source.next(property.count) }, () => source.next(property.type))
        : source.next(property.type);
    }
    take(row);
  }
}

function readerOf(type) {
  switch (type) {
    case "char": case "int8": return (view, at) => view.getInt8(at);
    case "uchar": case "uint8": return (view, at) => view.getUint8(at);
    case "short": case "int16": return (view, at) => view.getInt16(at, true);
    case "ushort": case "uint16": return (view, at) => view.getUint16(at, true);
    case "int": case "int32": return (view, at) => view.getInt32(at, true);
    case "uint": case "uint32": return (view, at) => view.getUint32(at, true);
    case "float": case "float32": return (view, at) => view.getFloat32(at, true);
    default: return (view, at) => view.getFloat64(at, true);
  }
}

function binaryReader(buffer, start) {
  const view = new DataView(buffer);
  let position = start;
  return {
    view,
    at: () => position,
    skip: (length) => { position += length; },
    next: (type) => {
      const value = readerOf(type)(view, position);
      position += SIZES[type];
      return value;
    },
  };
}

function asciiReader(buffer, start) {
  const words = new TextDecoder("latin1").decode(new Uint8Array(buffer, start)).split(/\s+/).filter(Boolean);
  let k = 0;
  return {
    next: () => {
      if (k >= words.length) throw new Error("the PLY file is cut short");
      return Number(words[k++]);
    },
  };
}
