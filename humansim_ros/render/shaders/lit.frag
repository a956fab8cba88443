#version 330
// Lit colour, and the truth with it. Light is added in linear space; x * x and sqrt(x) stand for the sRGB curve and its
// inverse. A face seen from behind is lit as its front would be if it looked that way.
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
void main() {
    vec3 n = normalize(gl_FrontFacing ? v_normal.xyz : -v_normal.xyz);
    vec3 albedo = texture(surface, v_uv).rgb * v_color;
    albedo *= albedo;
    vec3 light = mix(ground_color, sky_color, 0.5 + 0.5 * n.z) + sun_color * max(dot(n, sun), 0.0);
    rgb = vec4(sqrt(albedo * light), 1.0);
    depth = v_normal.w;
    label = first_label + uint(gl_PrimitiveID);
}
