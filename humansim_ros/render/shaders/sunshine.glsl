// How much of the sun a point sees, by maps of what is nearest to it (percentage-closer soft shadows, R. Fernando 2005).
struct ShadowMap {
    mat4 place;  // from the world to the map: x and y from 0 to 1, z in metres away from the sun
    vec3 size;   // metres along x, y and z
    float texel; // metres
};
uniform ShadowMap still_map, moving_map;
uniform sampler2DShadow still_shadows, moving_shadows;
uniform sampler2D still_depths, moving_depths;
uniform float spread;  // how much blurrier a shadow is for each metre: the tangent of half the angle of the sun
// evenly over a disc (H. Vogel 1979), from its middle outward
const vec2 DISC[16] = vec2[](
    vec2(0.1768, 0.0), vec2(-0.2258, 0.2068), vec2(0.0346, -0.3938), vec2(0.2846, 0.3712),
    vec2(-0.5223, -0.0924), vec2(0.4947, -0.3147), vec2(-0.1655, 0.6155), vec2(-0.3158, -0.6076),
    vec2(0.6846, 0.2500), vec2(-0.7123, 0.2941), vec2(0.3434, -0.7337), vec2(0.2540, 0.8089),
    vec2(-0.7649, -0.4431), vec2(0.8968, -0.1968), vec2(-0.5475, 0.7788), vec2(-0.1273, -0.9761)
);
#ifdef MOVING
#define LOOKS 4
#define TAPS 8
#else
#define LOOKS 8
#define TAPS 16
#endif
float sunshine(sampler2DShadow shadows, sampler2D depths, ShadowMap map, vec3 point, vec3 normal) {
    // off the surface by some texels, or its own steps in the map would shade it
    vec3 p = (map.place * vec4(point + normal * (1.5 * map.texel), 1.0)).xyz;
    if (any(lessThan(p.xy, vec2(0.0))) || any(greaterThan(p.xy, vec2(1.0)))) return 1.0;
    // how the surface itself recedes in the map
    vec3 n = mat3(map.place) * normal;  // rows scaled by 1 / size along x and y
    vec2 slope = -n.xy * map.size.xy / min(n.z, -0.25);
    slope *= min(1.0, 2.0 / max(length(slope), 1e-6));
    float reach = spread * max(p.z, 0.0) + map.texel, found = 0.0, sum = 0.0;
    for (int i = 16 / LOOKS - 1; i < 16; i += 16 / LOOKS) {
        vec2 o = DISC[i] * reach;
        float limit = p.z + min(dot(slope, o), 0.0) - map.texel;
        float z = texture(depths, p.xy + o / map.size.xy).r * map.size.z;
        if (z < min(limit, map.size.z * 0.99999)) {
            found += 1.0;
            sum += z;
        }
    }
    // most points see all of the sun or nothing
    if (found == 0.0 || found == float(LOOKS)) return found == 0.0 ? 1.0 : 0.0;
    float radius = max(spread * (p.z - sum / found), map.texel), seen = 0.0;
    for (int i = 16 / TAPS - 1; i < 16; i += 16 / TAPS) {
        vec2 o = DISC[i] * radius;
        float limit = p.z + min(dot(slope, o), 0.0) - map.texel;
        seen += texture(shadows, vec3(p.xy + o / map.size.xy, min(limit / map.size.z, 1.0)));
    }
    return seen / float(TAPS);
}
