/* The roll loop of profile study with limits, lane by lane in blocks the vector unit can take: a yardstick. */
#define W 64
#define FADE 6.981317007977318 /* 400 deg/s */
#define EPSILON 1.1920928955078125e-07
#define ACHIEVED 1e-5

/* m: (3, 4, n) rows v, p, phi; columns v, p, phi, command. g: k_phi, k, kp, ki, kd, int_lim, rate_max. phi, u: (ticks, n). */
void fly(long n, long ticks, const double *restrict m, const double *restrict g, const double *restrict phi_sp,
         double dt, double limit, long status_ticks, double *restrict phi_out, double *restrict u_out)
{
    const double kphi = g[0], k = g[1], kp = g[2], ki = g[3], kd = g[4], int_lim = g[5];
    for (long first = 0; first < n; first += W) {
        const long width = n - first < W ? n - first : W;
        double a[12][W], v[W] = {0}, p[W] = {0}, phi[W] = {0}, last[W] = {0}, sum[W] = {0}, high[W] = {0}, low[W] = {0};
        for (int c = 0; c < 12; c++)
            for (long j = 0; j < W; j++)
                a[c][j] = m[c * n + first + (j < width ? j : width - 1)];
        for (long t = 0; t < ticks; t++) {
            double u[W];
            const double want = phi_sp[t];
            const int status = (t + 1) % status_ticks == 0;
            for (long j = 0; j < W; j++) {
                const double rate_sp = kphi * (want - phi[j]);
                double error = rate_sp - p[j];
                const double slope = (p[j] - last[j]) / dt;
                const double torque = k * kp * error + sum[j] - k * kd * slope;
                last[j] = p[j];
                error = high[j] != 0.0 && error > 0.0 ? 0.0 : error;
                error = low[j] != 0.0 && error < 0.0 ? 0.0 : error;
                const double ratio = error / FADE;
                const double fade = 1.0 - ratio * ratio;
                double moved = sum[j] + (fade > 0.0 ? fade : 0.0) * k * ki * error * dt;
                moved = moved < -int_lim ? -int_lim : (moved > int_lim ? int_lim : moved);
                sum[j] = moved;
                const double given = torque < -limit ? -limit : (torque > limit ? limit : torque);
                if (status) {
                    const double missing = torque - given, wanting = missing * missing < ACHIEVED ? 0.0 : 1.0;
                    high[j] = missing > EPSILON ? wanting : 0.0;
                    low[j] = missing < -EPSILON ? wanting : 0.0;
                }
                u[j] = given;
            }
            for (long j = 0; j < width; j++) {
                phi_out[t * n + first + j] = phi[j];
                u_out[t * n + first + j] = u[j];
            }
            for (long j = 0; j < W; j++) {
                const double v1 = a[0][j] * v[j] + a[1][j] * p[j] + a[2][j] * phi[j] + a[3][j] * u[j];
                const double p1 = a[4][j] * v[j] + a[5][j] * p[j] + a[6][j] * phi[j] + a[7][j] * u[j];
                const double phi1 = a[8][j] * v[j] + a[9][j] * p[j] + a[10][j] * phi[j] + a[11][j] * u[j];
                v[j] = v1;
                p[j] = p1;
                phi[j] = phi1;
            }
        }
    }
}
