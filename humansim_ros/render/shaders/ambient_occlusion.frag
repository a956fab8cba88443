#version 330
// Visible share of sky and ground at a point, by depth maps of many directions. Neighbouring pixels, in blocks of nine,
// use different directions.
in vec3 v_world;
in vec4 v_normal;
uniform sampler2DShadow maps;
uniform vec3 directions[COUNT];
uniform vec3 centre;  // of the box that the maps cover
uniform vec3 extent;  // half of its sides
uniform float texel;  // metres
layout(location = 0) out vec4 sums;  // sky: visible, total; ground: visible, total
layout(location = 1) out float depth;
void main() {
    vec3 n = normalize(gl_FrontFacing ? v_normal.xyz : -v_normal.xyz);
    vec3 p = v_world + n * (1.5 * texel) - centre;
    ivec2 pixel = ivec2(gl_FragCoord.xy) % 3;
    sums = vec4(0.0);
    for (int i = pixel.x + 3 * pixel.y; i < COUNT; i += 9) {
        vec3 d = directions[i];
        float cosine = dot(n, d);
        if (cosine <= 0.0) continue;
        vec3 u = vec3(-d.y, d.x, 0.0) * inversesqrt(dot(d.xy, d.xy)), v = cross(d, u);
        vec3 lookup = 0.5 - 0.5 * vec3(-dot(p, u) / dot(abs(u), extent), -dot(p, v) / dot(abs(v), extent),
                                      (dot(p, d) + texel) / dot(abs(d), extent));
        float visible = 1.0;
        if (all(greaterThan(lookup.xy, vec2(0.0))) && all(lessThan(lookup.xy, vec2(1.0))))
            visible = texture(maps, vec3((vec2(i % SIDE, i / SIDE) + clamp(lookup.xy, INSET, 1.0 - INSET)) / float(SIDE), clamp(lookup.z, 0.0, 1.0)));
        vec2 light = vec2(visible, 1.0) * cosine;
        sums += d.z > 0.0 ? vec4(light, 0.0, 0.0) : vec4(0.0, 0.0, light);
    }
    depth = v_normal.w;
}
