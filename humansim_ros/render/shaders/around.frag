#version 330
// How much of sky and ground a point sees, by maps of what stands in each of many directions. Nine pixels beside each
// other look in different ones.
in vec3 v_world;
in vec4 v_normal;
uniform sampler2DShadow maps;
uniform vec3 directions[COUNT];
uniform vec3 centre;  // of what the maps show
uniform vec3 extent;  // from there to its sides
uniform float texel;  // metres
layout(location = 0) out vec4 seen;  // of sky and of ground, each: what is seen, what there is
layout(location = 1) out float depth;
void main() {
    vec3 n = normalize(gl_FrontFacing ? v_normal.xyz : -v_normal.xyz);
    vec3 p = v_world + n * (1.5 * texel) - centre;
    ivec2 pixel = ivec2(gl_FragCoord.xy) % 3;
    vec4 sums = vec4(0.0);
    for (int i = pixel.x + 3 * pixel.y; i < COUNT; i += 9) {
        vec3 d = directions[i];
        float falling = dot(n, d);
        if (falling <= 0.0) continue;
        vec3 u = vec3(-d.y, d.x, 0.0) * inversesqrt(dot(d.xy, d.xy)), v = cross(d, u);
        vec3 place = 0.5 - 0.5 * vec3(-dot(p, u) / dot(abs(u), extent), -dot(p, v) / dot(abs(v), extent),
                                      (dot(p, d) + texel) / dot(abs(d), extent));
        float open = 1.0;
        if (all(greaterThan(place.xy, vec2(0.0))) && all(lessThan(place.xy, vec2(1.0))))
            open = texture(maps, vec3((vec2(i % SIDE, i / SIDE) + clamp(place.xy, INSET, 1.0 - INSET)) / float(SIDE), clamp(place.z, 0.0, 1.0)));
        vec2 light = vec2(open, 1.0) * falling;
        sums += d.z > 0.0 ? vec4(light, 0.0, 0.0) : vec4(0.0, 0.0, light);
    }
    seen = sums;
    depth = v_normal.w;
}
