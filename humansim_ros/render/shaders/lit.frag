#version 330
// Lit colour, and the truth with it. Light is added in linear space; x * x and sqrt(x) stand for the sRGB curve and its
// inverse. A face seen from behind is lit as its front would be if it looked that way. What not every scene asks for is
// switched on by name: SHADELESS, FILMIC, and the shadows of what is still (STILL) and of what moves (MOVING).
in vec4 v_normal;
in vec2 v_uv;
in vec3 v_color;
uniform sampler2D surface;
uniform vec3 sun;        // direction to the light
uniform vec3 sun_color;
uniform vec3 sky_color;  // from above
uniform vec3 ground_color;
uniform uint first_label;
layout(location = 0) out float depth;
layout(location = 1) out uint label;
layout(location = 2) out vec4 rgb;
#ifdef STILL
in vec3 v_world;
#endif
void main() {
    vec3 n = normalize(gl_FrontFacing ? v_normal.xyz : -v_normal.xyz);
    vec3 albedo = texture(surface, v_uv).rgb * v_color;
#ifdef SHADELESS
    rgb = vec4(albedo, 1.0);
#else
    albedo *= albedo;
    float facing = max(dot(n, sun), 0.0);
    float unshadowed = 1.0;  // how much of its own light the surface lets through: alpha keeps what bodies leave of it
#ifdef STILL
    float still = facing > 0.0 ? sunshine(still_shadows, still_depths, still_map, v_world, n) : 0.0;
    unshadowed = still;
    facing *= still;
#ifdef MOVING
    float left = facing > 0.0 ? sunshine(moving_shadows, moving_depths, moving_map, v_world, n) : 0.0;
    facing *= left;
    unshadowed = dot(n, sun) > 0.0 ? 1.0 - still * (1.0 - left) : 0.0;
#endif
#endif
    vec3 light = mix(ground_color, sky_color, 0.5 + 0.5 * n.z) + sun_color * facing;
    rgb = vec4(developed(albedo * light), unshadowed);
#endif
    depth = v_normal.w;
    label = first_label + uint(gl_PrimitiveID);
}
