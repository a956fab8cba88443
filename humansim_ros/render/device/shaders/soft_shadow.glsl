// Visible share of the sun at a point, by percentage-closer soft shadows [Fernando 2005] on shadow maps.
struct ShadowMap {
    mat4 from_world;  // x and y from 0 to 1, z in metres away from the sun
    vec3 size;        // metres along x, y and z
    float texel;      // metres
};
uniform ShadowMap static_map, moving_map;
uniform sampler2DShadow static_shadows, moving_shadows;
uniform sampler2D static_depths, moving_depths;
uniform float penumbra_slope;  // tangent of half the angular size of the sun: penumbra per metre from the occluder
// points evenly over a disc [Vogel 1979], from the middle outward
const vec2 DISC[16] = vec2[](
    vec2(0.1768, 0.0), vec2(-0.2258, 0.2068), vec2(0.0346, -0.3938), vec2(0.2846, 0.3712),
    vec2(-0.5223, -0.0924), vec2(0.4947, -0.3147), vec2(-0.1655, 0.6155), vec2(-0.3158, -0.6076),
    vec2(0.6846, 0.2500), vec2(-0.7123, 0.2941), vec2(0.3434, -0.7337), vec2(0.2540, 0.8089),
    vec2(-0.7649, -0.4431), vec2(0.8968, -0.1968), vec2(-0.5475, 0.7788), vec2(-0.1273, -0.9761)
);
#ifdef MOVING_SHADOWS
#define BLOCKER_TAPS 4
#define FILTER_TAPS 8
#else
#define BLOCKER_TAPS 8
#define FILTER_TAPS 16
#endif
float sun_visibility(sampler2DShadow shadows, sampler2D depths, ShadowMap map, vec3 point, vec3 normal) {
    // offset by some texels, or the surface would shade itself
    vec3 p = (map.from_world * vec4(point + normal * (1.5 * map.texel), 1.0)).xyz;
    if (any(lessThan(p.xy, vec2(0.0))) || any(greaterThan(p.xy, vec2(1.0)))) return 1.0;
    // slope of the surface in the map
    vec3 n = mat3(map.from_world) * normal;  // rows scaled by 1 / size along x and y
    vec2 slope = -n.xy * map.size.xy / min(n.z, -0.25);
    slope *= min(1.0, 2.0 / max(length(slope), 1e-6));
    float radius = penumbra_slope * max(p.z, 0.0) + map.texel, blockers = 0.0, sum = 0.0;
    for (int i = 16 / BLOCKER_TAPS - 1; i < 16; i += 16 / BLOCKER_TAPS) {
        vec2 o = DISC[i] * radius;
        float limit = p.z + min(dot(slope, o), 0.0) - map.texel;
        float z = texture(depths, p.xy + o / map.size.xy).r * map.size.z;
        if (z < min(limit, map.size.z * 0.99999)) {
            blockers += 1.0;
            sum += z;
        }
    }
    // most points see the whole sun or nothing of it
    if (blockers == 0.0 || blockers == float(BLOCKER_TAPS)) return blockers == 0.0 ? 1.0 : 0.0;
    float visible = 0.0;
    radius = max(penumbra_slope * (p.z - sum / blockers), map.texel);
    for (int i = 16 / FILTER_TAPS - 1; i < 16; i += 16 / FILTER_TAPS) {
        vec2 o = DISC[i] * radius;
        float limit = p.z + min(dot(slope, o), 0.0) - map.texel;
        visible += texture(shadows, vec3(p.xy + o / map.size.xy, min(limit / map.size.z, 1.0)));
    }
    return visible / float(FILTER_TAPS);
}
