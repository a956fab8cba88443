// Reference streams of meshopt: encoded and decoded by npm's meshoptimizer (MIT), not by this package.
//
//     npm install meshoptimizer@1.3.0 && node tools/meshopt/streams.mjs > test/data/meshopt.json
import { MeshoptDecoder, MeshoptEncoder } from "meshoptimizer";

await MeshoptEncoder.ready;
await MeshoptDecoder.ready;

let state = 12345; // a linear congruential generator: two runs give the same file
const random = () => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0) / 2 ** 32;
const base64 = (bytes) => Buffer.from(bytes.buffer, bytes.byteOffset, bytes.byteLength).toString("base64");
const streams = [];

function add(name, mode, filter, count, stride, data) {
    const decoded = new Uint8Array(count * stride);
    MeshoptDecoder.decodeGltfBuffer(decoded, count, stride, data, mode, filter);
    streams.push({ name, mode, filter, count, stride, data: base64(data), decoded: base64(decoded) });
}

function attributes(name, filter, count, stride, source) {
    for (const version of [0, 1]) {
        for (const level of version ? [0, 2, 3] : [2]) {
            const data = MeshoptEncoder.encodeVertexBufferLevel(source, count, stride, level, version);
            add(`${name} v${version} level ${level}`, "ATTRIBUTES", filter, count, stride, data);
        }
    }
}

const bytes = (values) => new Uint8Array(values.buffer);
const wave = (count, width, make) => Float32Array.from({ length: count * width }, (_, i) => make(Math.floor(i / width), i % width));

attributes("positions", "NONE", 300, 12, bytes(wave(300, 3, (i, k) => Math.sin(i / 20 + k))));
attributes("quantised", "NONE", 530, 8, bytes(Uint16Array.from({ length: 530 * 4 }, (_, i) => (i % 4 === 3 ? 0 : 20000 + 9000 * Math.sin(i / 70) + 50 * random()))));
attributes("noise", "NONE", 40, 8, Uint8Array.from({ length: 320 }, () => 256 * random()));
attributes("constant", "NONE", 700, 4, new Uint8Array(2800).fill(7));
attributes("few", "NONE", 1, 16, Uint8Array.from({ length: 16 }, (_, i) => 17 * i));
attributes("small steps", "NONE", 257, 4, Uint8Array.from({ length: 1028 }, (_, i) => (i >> 3) + (random() < 0.1 ? 90 * random() : 0)));

const unit = (count, width) => {
    const out = new Float32Array(count * 4);
    for (let i = 0; i < count; ++i) {
        const v = Array.from({ length: width }, () => 2 * random() - 1);
        const length = Math.hypot(...v);
        v.forEach((x, k) => (out[4 * i + k] = x / length));
    }
    return out;
};
attributes("normals 8", "OCTAHEDRAL", 60, 4, MeshoptEncoder.encodeFilterOct(unit(60, 3), 60, 4, 8));
attributes("normals 12", "OCTAHEDRAL", 60, 8, MeshoptEncoder.encodeFilterOct(unit(60, 3), 60, 8, 12));
attributes("rotations", "QUATERNION", 60, 8, MeshoptEncoder.encodeFilterQuat(unit(60, 4), 60, 8, 14));
const moves = wave(60, 3, (i, k) => (k + 1) * Math.cos(i / 9) * 10 ** (k - 1));
attributes("translations", "EXPONENTIAL", 60, 12, MeshoptEncoder.encodeFilterExp(moves, 60, 12, 15, "SharedVector"));
const colors = Float32Array.from({ length: 240 }, (_, i) => (i % 4 === 3 ? 0.2 + 0.8 * random() : random()));
attributes("colours 8", "COLOR", 60, 4, MeshoptEncoder.encodeFilterColor(colors, 60, 4, 8));
attributes("colours 10", "COLOR", 60, 8, MeshoptEncoder.encodeFilterColor(colors, 60, 8, 10));

const grid = [];
for (let y = 0; y < 9; ++y) {
    for (let x = 0; x < 9; ++x) {
        const a = 10 * y + x;
        grid.push(a, a + 1, a + 10, a + 1, a + 11, a + 10);
    }
}
const shuffled = Array.from({ length: 120 }, () => Math.floor(60000 * random()));
for (const [name, list] of [["grid", grid], ["random", shuffled], ["restarts", [0, 1, 2, 2, 1, 3, 0, 1, 2, 100, 101, 99, 0, 1, 2]]]) {
    for (const stride of [2, 4]) {
        const source = new Uint8Array((stride === 2 ? Uint16Array : Uint32Array).from(list).buffer);
        add(`${name} triangles`, "TRIANGLES", "NONE", list.length, stride, MeshoptEncoder.encodeIndexBuffer(source, list.length, stride));
        add(`${name} indices`, "INDICES", "NONE", list.length, stride, MeshoptEncoder.encodeIndexSequence(source, list.length, stride));
    }
}
const optimised = Uint32Array.from(grid);
MeshoptEncoder.reorderMesh(optimised, true, false);
const source = new Uint8Array(optimised.buffer);
add("optimised grid", "TRIANGLES", "NONE", grid.length, 4, MeshoptEncoder.encodeIndexBuffer(source, grid.length, 4));
console.log("[\n" + streams.map((stream) => JSON.stringify(stream)).join(",\n") + "\n]");
