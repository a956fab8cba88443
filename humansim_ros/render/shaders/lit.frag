#version 330
// Lit colour, and the truth with it. Light is added in linear space; x * x and sqrt(x) stand for the sRGB curve and its
// inverse. A face seen from behind is lit as its front would be if it looked that way. What not every scene asks for is
// switched on by name: SHADELESS, FILMIC, the shadows of what is still (STILL) and of what moves (MOVING), PEOPLE of
// skin and cloth, AROUND which not all light reaches, FINISH of materials, OVER what is there, which they blend with, and
// STANDS for all that is still.
in vec4 v_normal;
in vec2 v_uv;
in vec3 v_color;
uniform sampler2D surface;  // alpha: of people, 0 is skin and 1 cloth
#ifdef STANDS
uniform float blur;  // levels of detail by which textures are coarser than usual
#endif
uniform vec3 sun;        // direction to the light
uniform vec3 sun_color;
uniform vec3 sky_color;  // from above
uniform vec3 ground_color;
uniform uint first_label;
#ifdef OVER
out vec4 rgb;
#else
layout(location = 0) out float depth;
layout(location = 1) out uint label;
layout(location = 2) out vec4 rgb;
#endif
#if defined(STILL) || defined(FINISH)
in vec3 v_world;
#endif
#ifdef PEOPLE
in vec3 v_answer;
uniform float dressed;  // 1 where it is known what is skin, 0 where all is matt
const vec3 DEEP = vec3(0.45, 0.22, 0.13);   // how far past its edge light goes on under skin: red farthest
const float THROUGH = 0.008;                // metres of skin that light goes through
const float ROUGH_EVEN = 0.92, ROUGH_MORE = 0.28;  // Oren and Nayar's A and B, as Fujii has them, for 0.3
const vec3 TINT = vec3(1.0, 0.95, 0.93);    // of light that has been under skin, and lost what skin does not let by
const float FUZZ = 0.25;                    // how much of grazing light the fibres of cloth send back
#endif
#ifdef AROUND
uniform usampler2D seen;  // how much of sky (8 bits) and of ground (8) is seen, and 1 / (1 + depth) of that (16)
uniform vec2 coarser;     // pixels of it for each pixel
const float SENT_ON = 0.6;
vec2 surroundings(float z) {
    vec2 place = gl_FragCoord.xy * coarser - 0.5;
    ivec2 low = ivec2(floor(place)), most = textureSize(seen, 0) - 1;
    vec2 share = place - vec2(low), sum = vec2(0.0);
    float total = 0.0;
    for (int i = 0; i < 4; i++) {
        ivec2 step = ivec2(i & 1, i >> 1);
        uint there = texelFetch(seen, clamp(low + step, ivec2(0), most), 0).r;
        vec2 weights = mix(1.0 - share, share, vec2(step));
        float weight = (weights.x * weights.y + 1e-3) / (1e-3 + abs(float(there >> 16u) / 65535.0 * (1.0 + z) - 1.0));
        sum += weight * vec2(uvec2(there & 255u, (there >> 8u) & 255u));
        total += weight;
    }
    return sum / (255.0 * total);
}
#endif
void main() {
    vec3 n = normalize(gl_FrontFacing ? v_normal.xyz : -v_normal.xyz);
#ifdef FINISH
    float opaque = opaqueness(v_uv);
    vec3 flat_n = n;
    n = bumped(n, v_world, v_uv);
    if ((one_sided && !gl_FrontFacing) || (masked && opaque < cutoff)) discard;
#endif
#ifdef STANDS
    vec4 texel = texture(surface, v_uv, blur);
#else
    vec4 texel = texture(surface, v_uv);
#endif
    vec3 albedo = texel.rgb * v_color;
#ifdef SHADELESS
    rgb = vec4(albedo, 1.0);
#else
    vec3 shown = albedo;
    albedo *= albedo;
    float slant = dot(n, sun), facing = max(slant, 0.0);
    vec3 direct = vec3(facing);
#ifdef PEOPLE
    float skin = dressed * (1.0 - texel.a), cloth = dressed - skin;
    vec3 past = max(DEEP - abs(slant), 0.0);
    direct = direct * (1.0 + cloth * (ROUGH_EVEN - 1.0 + ROUGH_MORE * v_answer.z)) + skin * past * past * (0.25 / DEEP);
#endif
    float sunlit = 1.0;
    float unshadowed = 1.0;  // how much of its own light the surface lets through: alpha keeps what bodies leave of it
#ifdef STILL
    vec3 where = v_world;
#ifdef PEOPLE
    where += sun * (skin * THROUGH);
#endif
    bool lit = direct.r > 0.0;
#ifdef FINISH
    vec3 off = flat_n;  // what a normal map says is no place
#else
    vec3 off = n;
#endif
    sunlit = lit ? sunshine(still_shadows, still_depths, still_map, where, off) : 0.0;
    unshadowed = sunlit;
#ifdef MOVING
    float left = lit ? sunshine(moving_shadows, moving_depths, moving_map, where, n) : 0.0;
    unshadowed = slant > 0.0 ? 1.0 - sunlit * (1.0 - left) : 0.0;
    sunlit *= left;
#endif
#endif
    vec3 around = mix(ground_color, sky_color, 0.5 + 0.5 * n.z);
#ifdef AROUND
    vec2 shares = surroundings(v_normal.w);
    around = sky_color * (0.5 + 0.5 * n.z) * shares.x + ground_color * (0.5 - 0.5 * n.z) * shares.y;
    // what stands there sends some on
    vec2 hidden = vec2(0.5 + 0.5 * n.z, 0.5 - 0.5 * n.z) * (1.0 - shares);
    around *= 1.0 + SENT_ON * (hidden.x + hidden.y);
#endif
    vec3 light = albedo * (around + sun_color * sunlit * direct);
#ifdef FINISH
    if (shines > 0.0) light = finished(albedo, n, v_world, v_uv, around, sky_color, ground_color, sun, sun_color * sunlit);
#endif
#ifdef PEOPLE
    light *= mix(vec3(1.0 - 0.1 * FUZZ * dressed), 0.92 * TINT, skin);  // what shines does not go in
    light += skin * (around * (0.01 + 0.15 * v_answer.y) + sun_color * (sunlit * facing * v_answer.x));
    light += cloth * FUZZ * v_answer.y * shown * (around + sun_color * (sunlit * facing));
#endif
    rgb = vec4(developed(light), unshadowed);
#endif
#ifdef OVER
    rgb.a = opaque;
#else
    depth = v_normal.w;
    label = first_label + uint(gl_PrimitiveID);
#endif
}
