#version 330
// Shadows of moving bodies on the image of the static scene, from its colours with and without sun.
uniform sampler2D sunlit_colour;  // alpha: visible share of the sun
uniform sampler2D shaded_colour;  // without sun
uniform sampler2D depths;         // metres, 0 where nothing is
uniform sampler2D rays;           // x and y of each pixel's ray where z is 1, optical frame
uniform mat4 world_from_optical;
uniform bool shadow_catcher;      // the invisible ground z = 0 takes shadows where nothing is
out vec4 rgb;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 lit = texelFetch(sunlit_colour, pixel, 0);
    float z = texelFetch(depths, pixel, 0).r;
    rgb = vec4(lit.rgb, 1.0);
    vec3 ray = mat3(world_from_optical) * vec3(texelFetch(rays, pixel, 0).xy, 1.0);
    if (z == 0.0 && shadow_catcher) z = max(-world_from_optical[3].z / ray.z, 0.0);
    if (z == 0.0 || lit.a == 0.0) return;
    vec3 point = world_from_optical[3].xyz + ray * z;
    float visibility = sun_visibility(moving_shadows, moving_depths, moving_map, point, vec3(0.0));
    if (visibility == 1.0) return;
    vec3 unlit = texelFetch(shaded_colour, pixel, 0).rgb;
    rgb = vec4(sqrt(mix(unlit * unlit, lit.rgb * lit.rgb, visibility)), 1.0 - lit.a * (1.0 - visibility));
}
