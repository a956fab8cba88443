#version 330
// Lit colour, depth and triangle id. Light is added in linear space; x * x and sqrt(x) approximate the sRGB curve and its
// inverse. A back face is lit as a front face that looks the same way. Features that not every scene needs are switched on
// by name: SHADELESS, FILMIC, STATIC_SHADOWS and MOVING_SHADOWS of the static scene and of moving bodies, SKIN_AND_CLOTH,
// AMBIENT_OCCLUSION, PBR for glTF materials, TRANSPARENT for surfaces that blend, COLOUR without depth and triangle id,
// UNSEEN without colour, STATIC_SCENE for static meshes, SMOOTH_TEXTURES for two samples of their texture in each pixel.
in vec4 v_normal;
in vec2 v_uv;
in vec3 v_color;
#ifdef STATIC_SCENE
flat in float v_layer;
uniform sampler2DArray surface;
uniform float mip_bias;  // mip levels by which textures are coarser than usual
#else
uniform sampler2D surface;  // alpha of humans: 0 is skin and 1 is cloth
#endif
uniform vec3 sun;        // direction to the light
uniform vec3 sun_color;
uniform vec3 sky_color;  // from above
uniform vec3 ground_color;
uniform uint first_id;
#ifdef COLOUR
layout(location = 0) out vec4 rgb;       // alpha: 1, which sums count
layout(location = 1) out float sunlight;  // share of the sun
#else
layout(location = 0) out float depth;
layout(location = 1) out uint triangle_id;
layout(location = 2) out vec4 rgb;
#endif
#if defined(STATIC_SHADOWS) || defined(PBR)
in vec3 v_world;
#endif
#ifdef SKIN_AND_CLOTH
in vec3 v_terms;
uniform float has_skin_mask;  // 1 if the texture has a skin mask, 0 if all is matt
const vec3 DEEP = vec3(0.45, 0.22, 0.13);   // light past the terminator, by scattering under skin
const float THROUGH = 0.008;                // metres of skin that light passes
const float ROUGH_EVEN = 0.92, ROUGH_MORE = 0.28;  // A and B of [Fujii 2012] for roughness 0.3
const vec3 TINT = vec3(1.0, 0.95, 0.93);    // of light that was scattered under skin
const float FUZZ = 0.25;                    // share of grazing light that fibres of cloth reflect
#endif
#ifdef AMBIENT_OCCLUSION
in vec2 v_light_uv;
uniform sampler2D light_map;  // visible share of sky and ground on the front, and on the back
const float INTERREFLECTION = 0.6;
#endif
void main() {
    vec3 n = normalize(gl_FrontFacing ? v_normal.xyz : -v_normal.xyz);
#ifdef PBR
    float opaque = opacity_at(v_uv);
    vec3 flat_n = n;
    n = perturbed_normal(n, v_world, v_uv);
    if ((one_sided && !gl_FrontFacing) || (masked && opaque < cutoff)) discard;
#endif
#ifdef UNSEEN
    return;
#endif
#ifdef SMOOTH_TEXTURES
    vec2 diagonal = 0.25 * (dFdx(v_uv) + dFdy(v_uv));
    vec4 texel = 0.5 * (texture(surface, vec3(v_uv - diagonal, v_layer), mip_bias) + texture(surface, vec3(v_uv + diagonal, v_layer), mip_bias));
#elif defined(STATIC_SCENE)
    vec4 texel = texture(surface, vec3(v_uv, v_layer), mip_bias);
#else
    vec4 texel = texture(surface, v_uv);
#endif
    vec3 albedo = texel.rgb * v_color;
#ifdef SHADELESS
    rgb = vec4(albedo, 1.0);
#else
    vec3 display = albedo;
    albedo *= albedo;
    float cosine = dot(n, sun), facing = max(cosine, 0.0);
    vec3 direct = vec3(facing);
#ifdef SKIN_AND_CLOTH
    float skin = has_skin_mask * (1.0 - texel.a), cloth = has_skin_mask - skin;
    vec3 past = max(DEEP - abs(cosine), 0.0);
    direct = direct * (1.0 + cloth * (ROUGH_EVEN - 1.0 + ROUGH_MORE * v_terms.z)) + skin * past * past * (0.25 / DEEP);
#endif
    float sunlit = 1.0;
    float unshadowed = 1.0;  // alpha: share of the sun that bodies leave
#ifdef STATIC_SHADOWS
    vec3 position = v_world;
#ifdef SKIN_AND_CLOTH
    position += sun * (skin * THROUGH);
#endif
    bool lit = direct.r > 0.0;
#ifdef PBR
    vec3 offset = flat_n;  // a normal map does not move the surface
#else
    vec3 offset = n;
#endif
    sunlit = lit ? sun_visibility(static_shadows, static_depths, static_map, position, offset) : 0.0;
    unshadowed = sunlit;
#ifdef MOVING_SHADOWS
    float visibility = lit ? sun_visibility(moving_shadows, moving_depths, moving_map, position, n) : 0.0;
    unshadowed = cosine > 0.0 ? 1.0 - sunlit * (1.0 - visibility) : 0.0;
    sunlit *= visibility;
#endif
#endif
    vec3 ambient = mix(ground_color, sky_color, 0.5 + 0.5 * n.z);
#ifdef AMBIENT_OCCLUSION
    vec4 sides = textureLod(light_map, v_light_uv, 0.0);
    vec2 shares = gl_FrontFacing ? sides.xy : sides.zw;
    ambient = sky_color * (0.5 + 0.5 * n.z) * shares.x + ground_color * (0.5 - 0.5 * n.z) * shares.y;
    // occluders reflect some light
    vec2 occluded = vec2(0.5 + 0.5 * n.z, 0.5 - 0.5 * n.z) * (1.0 - shares);
    ambient *= 1.0 + INTERREFLECTION * (occluded.x + occluded.y);
#endif
    vec3 light = albedo * (ambient + sun_color * sunlit * direct);
#ifdef PBR
    if (has_material > 0.0) light = shade_pbr(albedo, n, v_world, v_uv, ambient, sky_color, ground_color, sun, sun_color * sunlit);
#endif
#ifdef SKIN_AND_CLOTH
    light *= mix(vec3(1.0 - 0.1 * FUZZ * has_skin_mask), 0.92 * TINT, skin);  // specular light does not enter
    light += skin * (ambient * (0.01 + 0.15 * v_terms.y) + sun_color * (sunlit * facing * v_terms.x));
    light += cloth * FUZZ * v_terms.y * display * (ambient + sun_color * (sunlit * facing));
#endif
    rgb = vec4(tone_mapped(light), unshadowed);
#endif
#ifdef COLOUR
    sunlight = rgb.a;
    rgb = vec4(min(rgb.rgb, 1.0), 1.0);
#endif
#ifdef TRANSPARENT
    rgb.a = opaque;
#endif
#ifndef COLOUR
    depth = v_normal.w;
    triangle_id = first_id + uint(gl_PrimitiveID);
#endif
}
